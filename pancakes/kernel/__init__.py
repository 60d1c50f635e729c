"""The actor kernel of an agent: actors, mailboxes, the information stream, timers and dispatchers."""
