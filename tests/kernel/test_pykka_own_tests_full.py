"""pykka's own tests of actors, references, proxies and futures, with a component in the place of `ThreadingActor`.

They come from the source distribution of the pykka that is installed. What cannot pass is listed in
`pykka_differences.toml`, each with its reason; one that passes all the same fails here, as its reason has gone.
"""

import json
import os
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from kernel.pykka_releases import ROOT, allowed, pip, unpacked_sdist

HERE = Path(__file__).parent
PATIENCE_S = 100.0
OUTCOMES = "PYKKA_OUTCOMES"
DIFFERENCES = tomllib.loads((HERE / "pykka_differences.toml").read_text())
FAILS, UNSURE = set(DIFFERENCES["fails"]), set(DIFFERENCES["depends_on_timing"])


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """What became of each of pykka's tests."""
    folder = tmp_path_factory.mktemp("pykka")
    try:
        source = unpacked_sdist(version("pykka"), folder)
        pip("install", "--quiet", "--no-deps", "--target", folder / "lib", "pytest-mock")
    except OSError as error:
        pytest.skip(f"pykka's tests cannot be fetched: {error}")
    told = folder / "outcomes.json"
    paths = [HERE.parent, folder / "lib", ROOT]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths)), OUTCOMES: str(told)}
    command = [sys.executable, "-m", "pytest", "-p", "kernel.pykka_runtime", "-q", "--import-mode=prepend"]
    command += ["-c", os.devnull, "--rootdir", str(source), "--timeout", "10", "tests"]
    done = subprocess.run(
        command, cwd=source, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert told.exists(), done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(told.read_text())


def test_a_component_does_what_pykka_asks_of_an_actor(outcomes):
    assert len(outcomes) > 100, "these are not all of pykka's tests"
    failed = {name for name, outcome in outcomes.items() if outcome == "failed"}
    assert sorted(failed - FAILS - UNSURE) == [], "these should pass"


def test_each_difference_that_is_listed_is_one_still(outcomes):
    passed = {name for name, outcome in outcomes.items() if outcome != "failed"}
    assert sorted(passed & FAILS) == [], "these pass: take them off the list"
    assert sorted((FAILS | UNSURE) - set(outcomes)) == [], "pykka has no such tests"


def test_the_contract_holds_for_each_pykka_that_setup_cfg_allows(tmp_path):
    try:
        others = [release for release in allowed() if release != version("pykka")]
    except OSError as error:
        pytest.skip(f"nothing says which releases of pykka there are: {error}")
    if not others:
        pytest.skip(f"setup.cfg allows one release of pykka, {version('pykka')}, which all other tests use")
    for release in others:
        folder = tmp_path / release
        pip("install", "--quiet", "--no-deps", "--target", folder, f"pykka=={release}")
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(HERE.parent), str(ROOT)])}
        command = [sys.executable, "-m", "pytest", "-q", str(HERE / "test_pykka_contract.py")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        assert done.returncode == 0, f"with pykka {release}:\n{done.stdout[-2000:]}"
