"""An agent's process tunes its Python interpreter for many threads; other programs that use Pancakes do not."""

import subprocess
import sys

from cli.processes import Rig

_SAY = "import gc, sys; print(sys.getswitchinterval(), *gc.get_threshold())"


def said(code):
    done = subprocess.run([sys.executable, "-c", f"{code}; {_SAY}"], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_agent_interpreter_is_tuned_for_threads():
    usual = said("pass")
    prepared = said("from pancakes.tools.cli import agent_process; agent_process.tune_interpreter()")
    assert float(prepared[0]) < float(usual[0]) / 5
    assert int(prepared[1]) > int(usual[1])

    begin = "import resource as r; r.setrlimit(r.RLIMIT_NOFILE, (256, r.getrlimit(r.RLIMIT_NOFILE)[1]))"
    prepare = "from pancakes.tools.cli import agent_process; agent_process.tune_interpreter()"
    assert int(said(f"{begin}; {prepare}; print(r.getrlimit(r.RLIMIT_NOFILE)[0])")[0]) >= 1024, "of 256 files before"

    imported = "import pancakes.agent.agent, pancakes.testing, pancakes.tools.cli.agent_command"
    assert said(imported) == usual, "who only imports pancakes keeps what Python has"


def test_agent_interpreter_freezes_imports(rig: Rig):
    rig.install(
        "looking",
        "[pancakes.tasks]\ntest.Look = plugin_looking:Look\n",
        "import gc\n"
        "from pancakes.task import Task\n"
        "class Look(Task):\n"
        "    def on_start(self):\n"
        "        self.log('info', f'{gc.get_freeze_count()} are kept, {len(gc.get_objects())} are left')\n",
    )
    agent = rig.agent(rig.config("a", '[task.Look]\ntype = "test.Look"\n'), true_start=True)
    words = agent.hear("are kept").split()
    kept, left = (int(words[words.index(word) - 2]) for word in ("kept,", "left"))
    assert kept > left > 0
