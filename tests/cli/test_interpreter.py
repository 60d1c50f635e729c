"""An agent's process sets its Python interpreter up for many threads; a program that uses Pancakes is left alone."""

import subprocess
import sys

_SAY = "import gc, sys; print(sys.getswitchinterval(), *gc.get_threshold())"


def said(code):
    done = subprocess.run([sys.executable, "-c", f"{code}; {_SAY}"], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_an_agents_process_gives_way_often_and_collects_rarely():
    usual = said("pass")
    prepared = said("from pancakes.cli import interpreter; interpreter.prepare()")
    assert float(prepared[0]) < float(usual[0]) / 5
    assert int(prepared[1]) > int(usual[1])


def test_who_only_imports_pancakes_keeps_what_python_has():
    assert said("import pancakes.agent, pancakes.testing, pancakes.cli.agent") == said("pass")
