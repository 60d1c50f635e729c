"""Tasks that let a robot last: they watch it, and ask other tasks by control packets to do less (paper §3.4)."""
