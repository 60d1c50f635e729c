"""Learning environments for gymnasium (extra `gym`); importing this module registers them.

    import gymnasium
    import pancakes.gym

    environment = gymnasium.make("pancakes/DriveToGoal-v0")

In one go, also in a process that imports nothing else: `gymnasium.make("pancakes.gym:pancakes/DriveToGoal-v0")`.
"""

from pancakes.errors import needing_extra
from pancakes.simulation.drive_to_goal import DriveToGoal

with needing_extra("no learning environment can be made"):
    from gymnasium import register

__all__ = ["DriveToGoal"]

register("pancakes/DriveToGoal-v0", entry_point="pancakes.simulation.drive_to_goal:DriveToGoal", max_episode_steps=600)
