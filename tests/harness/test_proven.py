"""What a run with `--prove` writes down."""

import json

import pytest
from harness import proven


@pytest.mark.parametrize(
    ("ended", "outcomes", "proves"),
    [
        (pytest.ExitCode.OK, ["passed", "passed"], True),
        (pytest.ExitCode.TESTS_FAILED, ["passed", "failed"], False),
        (pytest.ExitCode.INTERRUPTED, ["passed"], False),
    ],
)
def test_only_a_run_that_was_whole_and_passed_proves_a_subject(tmp_path, monkeypatch, ended, outcomes, proves):
    monkeypatch.setattr(proven, "FILE", tmp_path / "proven.json")
    prover = proven.Prover()
    for outcome in outcomes:
        place = "tests/ros2/test_bags.py"
        prover.pytest_runtest_logreport(pytest.TestReport(f"{place}::x", (place, 0, "x"), {}, outcome, None, "call"))
    prover.pytest_sessionfinish(ended)
    written = json.loads(proven.FILE.read_text()) if proven.FILE.is_file() else {}
    assert ("ROS 2" in written) is proves
