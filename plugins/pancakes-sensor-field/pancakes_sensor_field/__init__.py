"""A field of sensor nodes that Pancakes agents watch over, as a distribution of its own.

The wire format of the tiny nodes (`frame`), what such a node does (`mote`) and the program that plays one
(`tiny_node`) import nothing of Pancakes. The decisions (`station`, `duty`, `fusion`, `physics`) are pure; tasks
and drivers carry them out. `verdict` and `figure` judge and draw a mission from the files that it leaves behind.
"""
