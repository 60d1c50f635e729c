"""What was recorded, once more: fed into a fleet (`pancakes replay`), or into one task's present code (`rerun`)."""
