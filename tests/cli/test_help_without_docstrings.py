"""Help and schemas are the same if Python removes docstrings (`-OO`)."""

import os
import subprocess
import sys

PRINTED = """
import json
import click
from pancakes.config.schema import config_schema
from pancakes.util.plugins import Plugins
from pancakes.tools.cli.agent_command import agent
from pancakes.tools.cli.main import pancakes

def helps(command, words):
    context = command.make_context(words[-1], [], resilient_parsing=True)
    yield " ".join(words), command.get_help(context)
    for name in command.list_commands(context) if isinstance(command, click.Group) else ():
        yield from helps(command.get_command(context, name), (*words, name))

found = dict([*helps(pancakes, ("pancakes",)), *helps(agent, ("pancakes-agent",))])
print(json.dumps([found, config_schema(Plugins())], sort_keys=True))
"""


def printed(optimize: str) -> str:
    env = {**os.environ, "PYTHONOPTIMIZE": optimize, "COLUMNS": "100"}
    done = subprocess.run([sys.executable, "-c", PRINTED], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_help_and_schemas_are_the_same_without_docstrings() -> None:
    said = printed("")
    assert "Stop a task, start it" in said and "how often it is sampled" in said
    assert printed("2") == said
