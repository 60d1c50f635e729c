"""Find out what happened to a task in trouble, and set it right: `pancakes task recover`.

`looking` asks the agents, `diagnosis` decides what happened and what to do, and `acting` does it.
"""
