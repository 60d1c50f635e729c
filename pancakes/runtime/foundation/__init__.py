"""What the rest stands on: values and how they are encoded and checked, names, and what sentences say of code."""
