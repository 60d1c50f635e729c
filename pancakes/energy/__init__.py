"""Energy: tasks that watch the battery and ask other tasks, by control packets, to do less (paper §3.4)."""
