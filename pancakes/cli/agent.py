"""`pancakes-agent`: runs one agent from its configuration file, until it is told to stop."""

from __future__ import annotations

import sys

from pancakes.cli.agent_options import usual


def main() -> None:
    """The console script."""
    options = usual(sys.argv[1:])
    if options is None:
        from pancakes.cli.agent_command import agent
        from pancakes.cli.errors import sentences

        sentences(agent)()
    else:
        from pancakes.cli.agent_process import run

        run(options)


if __name__ == "__main__":
    from pancakes.cli import entry  # noqa: F401 - a SIGINT ends it quietly

    main()
