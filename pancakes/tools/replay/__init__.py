"""Use a recording as input again: of a whole fleet (`pancakes replay`), or of one task's present code (`rerun`)."""
