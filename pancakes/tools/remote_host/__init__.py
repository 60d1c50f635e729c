"""Run Pancakes' part on another machine, over SSH. These modules are sent there, so they need only Python."""
