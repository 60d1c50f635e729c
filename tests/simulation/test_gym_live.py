"""The learning environment in a Python of its own: how it is found, and what is said without gymnasium."""

from __future__ import annotations

import subprocess
import sys

ID = "pancakes/DriveToGoal-v0"


def test_gym_environment_is_found_by_its_name():
    program = f"import gymnasium; print(gymnasium.make('pancakes.gym:{ID}').spec.max_episode_steps)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["600"]


def test_gym_names_the_extra_if_gymnasium_is_missing():
    program = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "from pancakes.errors import PancakesError\n"
        "try:\n    import pancakes.gym\nexcept PancakesError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == (
        "no learning environment can be made without gymnasium: pip install 'pancakes-agents[gym]'\n"
    )
