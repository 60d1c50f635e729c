"""Arguments of all verbs: help with an example, usage errors, and verbs without a running agent."""

from __future__ import annotations

from collections.abc import Iterator

import click
import pytest
from cli.invoked import invoked
from cli.processes import Rig

from pancakes.tools.cli.main import COMMANDS, pancakes
from pancakes.tools.cli.options import Duration

BODY = '{"voltage_v": 7.4, "level": 0.75}'
# After the `#`: a part of the message, if it is the verb's own.
FAULTS = """
agent list --at 127.0.0.1:
agent list --timeout 0
agent list --timeout 1_0
agent list --timeout 2hours  # write it as 30s, 500ms, 2min or 1h
agent list --timeout 2h  # '2h' is more than 3600s
demo field --duration 500ms  # '500ms' is less than 1s
task rate a/Count 1_0
agent lisst
agent info
agent info x/north/a  # is not a valid agent name: write it as AGENT or FLEET/AGENT
agent info test/a/client
agent info north/a --fleet south  # a command talks to one fleet, not to south (--fleet) and north
agnt
task list --state runing
task list --timeout nan
task list north/a south/a  # a command talks to one fleet, not to north and south
task stop Count
task stop a/b/c/d/e
task stop a/
task info x/north/a/device/load  # is not a valid task name
task start a/Idle --set step
task rate a/Count fast
task rate a/Count -1
task rate a/Count nan
task migrate Count
task recover Count
task recover a/Count --here --not-here  # contradict each other
task recover a/Count --config a.toml  # pass --here too
task recover --yes  # name the task to recover
task create a/Count --type count.Count --guard 5 --key guard.copies=3  # --guard and --key guard.copies set the same key
task fence a/wheels --reset a/Circle  # No such option
task recover d/Count --here --set x=1  # pass --config FILE too
service stop a
service stop test/a/client/Count
service stop a/client --for soon
service stop a/client --for 0s
channel echo pond
channel echo test/a/client/pond
channel echo a/pond --count 0
channel echo a/system --type load --field cpuu --count 1  # load has no field 'cpuu', did you mean 'cpu'?
channel hz a/pond --for soon
channel hz a/pond --window 1
param set a/Count
param set a/Count step
param set a step=1
param get a
param list a/b/c/d/e
log --grep a(b
log --level loud
log --since ever
record repair
task rate a/b -1  # -1.0 is not in the range x>=0.0
task rate a/b -x  # No such option
what-if rate a/b -.5  # -0.5 is not in the range x>=0.0
down --at 127.0.0.1:7401
down --all
config schema --fleet --plugins
plugin list --group thing
completion tcsh
view --foxglove --control  # --foxglove takes only --port
""".strip().splitlines()
PUBLISHED = {
    ("batery", BODY): "no packet type 'batery' is installed here, did you mean 'battery'?",
    ("battery", '{"voltage_v": "high", "level": 1}'): "battery.voltage_v: expected `float`, got `str`",
    ("battery", '{"level": 1}'): "battery: object missing required field `voltage_v`",
    ("battery", '{"voltage_v": 1, "level": 1, "livel": 2}'): "battery has no field 'livel', did you mean 'level'?",
    (
        "battery",
        "[1, 2]",
    ): "the body must be a JSON object with the fields of battery: voltage_v (float), level (float)",
    ("battery", '{"level": '): "the body is not JSON: input data was truncated",
    ("battery", "{level: 1}"): "the body is not JSON: object keys must be strings",
    ("battery", BODY, "--rate", "0"): "--rate",
    ("battery", BODY, "--to", "b/client/Watch"): "--to",
    ("battery", BODY, "--to", "*"): "--to",
}
ASK_AGENTS = """
agent info a
agent list
agent reload-keys a
channel echo a/pond --count 1
channel info a/pond
channel list
channel pub a/pond battery {"voltage_v":1,"level":1}
down a
log
log a -f
param get a/Count
param list
record start
service list
service stop a/client
task create a/Count --type count.Count
task fence a/wheels
task list
task recover
task recover a/Count
task migrate a/Count
task stop a/Count
top
top --once
""".strip().splitlines()


def verbs(group: click.Group, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Yield all verbs of a group, each with its words."""
    context = click.Context(group)
    for name in COMMANDS if group is pancakes else group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from verbs(command, (*path, name))
        else:
            yield (*path, name), command


def test_help_of_every_verb_has_an_example():
    without = [
        words
        for words, _ in verbs(pancakes)
        if f"pancakes {' '.join(words)}" not in invoked(*words, "--help").output.partition("Example:")[2]
    ]
    assert without == []


def test_every_verb_that_changes_something_has_dry_run():
    """Verbs that only read, and verbs that need no dry run, are listed by name."""
    harmless = {
        *("agent info", "agent list", "agent unit", "agent run"),
        *("log", "rerun", "why", "view", "report", "top", "what-if", "demo", "config", "plugin", "doctor"),
        "completion",
        *("task fence", "task guards", "task info", "task list", "task migrations", "service info", "service list"),
        *("channel bw", "channel echo", "channel hz", "channel info", "channel list"),
        *("param describe", "param dump", "param get", "param list", "keys can", "keys list"),
        *("record info", "record list"),
    }
    without = [
        " ".join(words)
        for words, command in verbs(pancakes)
        if "--dry-run" not in {option for parameter in command.params for option in parameter.opts}
    ]
    assert [it for it in without if it not in harmless and it.split()[0] not in harmless] == []


def test_every_verb_that_prints_rows_has_format():
    without = [
        " ".join(words)
        for words, command in verbs(pancakes)
        if "--format" not in {option for parameter in command.params for option in parameter.opts}
    ]
    assert without == ["agent run", "drive"], "one prints the log of the agent, the other where keys are pressed"


def test_options_for_times_accept_units():
    others = {
        f"{' '.join(words)} {parameter.opts[0]}"
        for words, command in verbs(pancakes)
        for parameter in command.params
        if isinstance(parameter.type, click.FloatRange | click.types.FloatParamType)
        and (parameter.name or "").endswith(("_s", "timeout", "duration"))
    }
    assert others == set()


@pytest.mark.parametrize(
    ("text", "seconds"), [("2", 2.0), ("2s", 2.0), ("500ms", 0.5), (".5", 0.5), ("5min", 300.0), ("1h", 3600.0)]
)
def test_times_are_parsed_with_or_without_unit(text, seconds):
    assert Duration(most_s=3600.0).convert(text, None, None) == seconds


def test_usage_errors_exit_with_2():
    """They are found before an agent is contacted: no agent runs here, which would exit with 3."""
    found = {}
    for line in FAULTS:
        words, _, part = line.partition("  # ")
        result = invoked(*words.split(" "))
        said = " ".join(result.stderr.split())
        if result.exit_code != 2 or "Usage: " not in said or part not in said or result.stdout:
            found[words] = (result.exit_code, result.output)
    assert found == {}


def test_unfit_pub_body_is_not_sent():
    done = {words: invoked("channel", "pub", "a/pond", *words) for words in PUBLISHED}
    assert {
        words: result.output
        for words, result in done.items()
        if result.exit_code != 2 or PUBLISHED[words] not in result.stderr
    } == {}


def test_mistyped_verb_gets_a_suggestion(rig: Rig):
    result = rig.pancakes("tsk", "list")
    assert result.returncode == 2 and result.stdout == ""
    assert "Did you mean 'task'?\n" in result.stderr


def test_verbs_without_agents_exit_with_3(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path / "runtime"))
    done = {line: invoked(*line.split()) for line in ASK_AGENTS}
    begin = f"no agent runs on this machine ({tmp_path}/runtime names none)"
    assert {
        line: (result.exit_code, result.output)
        for line, result in done.items()
        if result.exit_code != 3 or not result.stderr.startswith(begin) or result.stdout
    } == {}
