#!/usr/bin/env python3
"""Check on a GPU that CUDA makes what the CPU makes: ``check_cuda.py [PYTEST_OPTION ...]``, in about five minutes.

It runs the tests that are marked ``cuda``: images and gradients against a float64 reference, losses, compaction and
fine-tuning against the CPU; and prints a table. Exit code 0 if all that are not skipped pass, 1 if one fails
or none passed, 2 without a GPU.
"""

import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("rendering", "compaction", "finetuning")  # that have such tests


class Table:
    """Collect what became of each test."""

    def __init__(self) -> None:
        """Begin with no test."""
        self.rows: dict[str, tuple[int, int, int, float]] = {}

    @property
    def passed(self) -> int:
        """Number of tests that passed."""
        return sum(passed for passed, *_ in self.rows.values())

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a test that has run, or failed or was skipped before."""
        if report.when == "call" or not report.passed:
            name = report.nodeid.partition("[")[0]
            passed, failed, skipped, seconds = self.rows.get(name, (0, 0, 0, 0.0))
            counts = passed + report.passed, failed + report.failed, skipped + report.skipped
            self.rows[name] = (*counts, seconds + report.duration)

    def lines(self) -> list[str]:
        """Return the table."""
        head = f"{'passed':>6} {'failed':>6} {'skipped':>7} {'seconds':>8}  test"
        return [head, *(f"{p:6} {f:6} {n:7} {s:8.1f}  {name}" for name, (p, f, n, s) in self.rows.items())]


def main(options: list[str]) -> int:
    """Run the tests and return the exit code."""
    if find_spec("torch") is None or find_spec("gsplat") is None:
        return without("torch or gsplat is not installed: pip install torch gsplat")
    import torch

    if not torch.cuda.is_available():
        return without("torch finds no CUDA device")
    table = Table()
    rooms = [str(ROOT / "tests" / room) for room in ROOMS]
    code = pytest.main(["-q", "-m", "cuda", *options, *rooms], plugins=[table])
    print("\n".join([torch.cuda.get_device_name(), *table.lines()]))  # noqa: T201
    return int(code != 0 or table.passed == 0)


def without(what: str) -> int:
    """Say in one sentence what is missing, and return the exit code."""
    sys.stderr.write(f"nothing was checked: {what}\n")
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
