"""What Pancakes runs on another machine, over SSH. The modules are sent there, so they need nothing but Python."""
