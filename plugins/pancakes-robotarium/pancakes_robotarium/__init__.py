"""Georgia Tech's Robotarium as a world: its simulator `rps`, on the hardware bus of every simulated world.

`laboratory` is the only module that knows `rps`, and keeps its faults from users. `world` is the task, `gternal` the
robot, `demos` the encirclement of the paper in that laboratory, judged by its simulator's own counts as well as ours.
"""
