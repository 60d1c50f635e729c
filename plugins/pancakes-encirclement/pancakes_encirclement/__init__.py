"""The encirclement experiment of the Pancakes paper (§4), as tasks that any agent can load by entry point.

The laws (`circle`, `homing`, `avoidance`, `local_map`) are pure functions of what a robot knows; the tasks carry
them out with packets. `verdict` and `figure` judge and draw a mission from the files that it leaves behind.
"""
