"""Processes side by side: their number, their order, stops and reasons for failures."""

import signal
import sys

import pytest

from legged.process.processes import BUILT, Job, WorkerPool, why_failed
from legged.process.startup import STAGES_FILE


def script(name, log, built_after=0.0, lasts=0.3, code="", done=lambda job, code: []):
    """Return a job that notes its begin and end, and reports its stage `BUILT` after some time."""
    text = (
        "import os, time\n"
        f"note = lambda what: open({str(log)!r}, 'a').write(f'{name} {{what}}\\n')\n"
        "note('begins')\n"
        f"time.sleep({built_after})\n"
        f"open(os.environ[{STAGES_FILE!r}], 'a').write('1.0 {BUILT}\\n')\n"
        f"note('is built')\n{code}\n"
        f"time.sleep({lasts})\n"
        "note('ends')\n"
    )
    return Job([sys.executable, "-c", text], log.with_name(f"{name}.txt"), done)


@pytest.mark.slow
def test_a_training_begins_when_there_is_room_and_the_one_before_it_is_built(tmp_path):
    log = tmp_path / "log"
    WorkerPool(2).run([script(name, log, built_after=0.2, lasts=1.0) for name in "abc"])
    noted = log.read_text().splitlines()
    assert noted[:3] == ["a begins", "a is built", "b begins"]
    assert noted.index("a ends") < noted.index("c begins")
    assert not list(tmp_path.glob("*.stages"))


@pytest.mark.slow
def test_what_follows_from_a_job_runs_after_it(tmp_path):
    log = tmp_path / "log"
    after = script("b", log)
    WorkerPool(1).run([script("a", log, done=lambda job, code: [after])])
    assert [line for line in log.read_text().splitlines() if "is built" not in line] == [
        *("a begins", "a ends"),
        *("b begins", "b ends"),
    ]


def test_a_pool_that_is_stopped_starts_nothing_more_and_tells_those_that_run(tmp_path):
    log = tmp_path / "log"
    asked = "import signal\nsignal.signal(signal.SIGTERM, lambda *_: (note('was asked'), exit(3)))"
    codes = []
    jobs = [script("a", log, lasts=60, code=asked, done=lambda job, code: codes.append(code) or [])]
    jobs.append(script("b", log))
    pool = WorkerPool(1)
    handler = signal.signal(signal.SIGALRM, lambda *_: pool.stop() if log.is_file() and "built" in log.read_text() else None)
    signal.setitimer(signal.ITIMER_REAL, 0.1, 0.1)
    try:
        pool.run(jobs)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
    assert log.read_text().splitlines() == ["a begins", "a is built", "a was asked"]
    assert codes == [3]


def test_why_a_process_failed(tmp_path):
    job = Job([], tmp_path / "out.txt", lambda job, code: [])
    assert why_failed(job, 7) == "exit code 7"
    job.output.write_text("hello\nValueError: no\n\n")
    assert why_failed(job, 1) == "ValueError: no"
    assert why_failed(job, -9) == "killed by SIGKILL, maybe out of memory"
    assert why_failed(job, -11) == "killed by SIGSEGV"
    job.output.write_text("error: --task: there is no task\nbye\n")
    assert why_failed(job, 2) == "--task: there is no task"
