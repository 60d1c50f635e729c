"""`scripts/readme` runs the commands of the README."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]

LIMIT_S = 2.0
"""The time limit of one statement in tests that wait for it to pass; bash must start faster on any machine."""

TEXT = """\
A command, and what it prints:

```sh
# a comment
echo one \\
  two
for n in 1 2
do
  echo $n
done
cat > hello.txt <<'END'
echo not a command
END
```

```console
$ false
```

```python tasks/blink.py
print("blink")
```

  ```sh
  false
  ```
"""


@pytest.fixture(scope="module")
def readme() -> ModuleType:
    """The script's module, which is not in a package."""
    library = ROOT / "scripts" / "lib"
    sys.path.insert(0, str(library))
    try:
        spec = importlib.util.spec_from_file_location("readme_commands", library / "readme.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses look there
        spec.loader.exec_module(module)
        return module
    finally:
        sys.path.remove(str(library))


def test_blocks_have_info_string_and_line(readme):
    found = [(block.info, block.line) for block in readme.blocks(TEXT)]
    assert found == [("sh", 4), ("console", 17), ("python tasks/blink.py", 21), ("sh", 25)]
    assert readme.blocks(TEXT)[2].text == 'print("blink")\n'
    assert readme.blocks(TEXT)[3].text == "false\n"


def test_statement_keeps_all_of_its_lines(readme):
    first = readme.blocks(TEXT)[0]
    assert [(it.line, it.text) for it in readme.statements(first)] == [
        (5, "echo one \\\n  two"),
        (7, "for n in 1 2\ndo\n  echo $n\ndone"),
        (11, "cat > hello.txt <<'END'\necho not a command\nEND"),
    ]


def run(readme, tmp_path, *commands, limit_s=20.0):
    """Run commands like those of a README; return the failures."""
    for name in ("copy", "home", "run"):
        (tmp_path / name).mkdir()
    statements = [readme.Statement(number, text) for number, text in enumerate(commands, 1)]
    return readme.run(statements, "README.md", tmp_path / "copy", tmp_path, limit_s)


def test_commands_run_in_one_shell_and_failures_are_named(readme, tmp_path):
    failures = run(readme, tmp_path, "word=yes", "ls nothing", "echo $word > answer", "exit 3", "true")
    assert failures == ["README.md:2: ended with 2: ls nothing", "README.md:4: ended the shell: exit 3"]
    assert (tmp_path / "copy" / "answer").read_text() == "yes\n"


def test_slow_command_is_ended_with_its_children(readme, tmp_path):
    failures = run(readme, tmp_path, "sleep 1001 &", "echo $! > pid", "sleep 1000", limit_s=LIMIT_S)
    assert failures == [f"README.md:3: took longer than {LIMIT_S:g} s: sleep 1000"]
    pid = (tmp_path / "copy" / "pid").read_text().strip()
    listed = subprocess.run(["ps", "-o", "stat=", "-p", pid], capture_output=True, text=True)
    assert listed.stdout[:1] in ("", "Z"), "it runs on"


PRINTS = """\
```sh
echo early
```

```sh
echo "lamp   green  12.5 s"
echo other
echo late
```

```text output
lamp green ... s
late
```
"""


@pytest.mark.parametrize(
    ("expected", "lacking"),
    [
        ("lamp green ... s\nlate", ""),
        ("...\nother", ""),
        ("late\nother", "other"),
        ("early", "early"),
        ("lamp green", "lamp green"),
        ("lamp . s", "lamp . s"),
    ],
)
def test_output_is_compared_line_by_line(readme, tmp_path, expected, lacking):
    text = PRINTS.replace("lamp green ... s\nlate", expected)
    for name in ("copy", "home", "run"):
        (tmp_path / name).mkdir()
    failures = readme.run(readme.commands(readme.blocks(text)), "README.md", tmp_path / "copy", tmp_path, 20.0)
    assert failures == (
        [f"README.md:12: this line was not printed, or not in this order: {lacking}"] if lacking else []
    )


BACKGROUND = """\
```sh background
echo begun; read -r _ < pipe; echo ended
```

```text output
begun
```

```sh
echo go > pipe
wait
```
"""


def test_background_block_runs_on_after_its_output(readme, tmp_path):
    for name in ("copy", "home", "run"):
        (tmp_path / name).mkdir()
    subprocess.run(["mkfifo", str(tmp_path / "copy" / "pipe")], check=True)
    failures = readme.run(readme.commands(readme.blocks(BACKGROUND)), "README.md", tmp_path / "copy", tmp_path, 20.0)
    assert failures == []
    assert (tmp_path / "background-0.log").read_text() == "begun\nended\n"


def test_readme_of_the_project_can_be_parsed(readme):
    for block in readme.blocks((ROOT / "README.md").read_text()):
        if block.info == "sh":
            assert all(readme.is_whole(statement.text) for statement in readme.statements(block))
