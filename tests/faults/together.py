"""Two processes at the same work in the same folder: the first is stopped amid a write, the second comes.

    python tests/faults/together.py WORK ...

The outcome goes to stdout as JSON, one object a work: the first's number, what the second was told (null where it
worked), and `fault`, null or what was wrong with the result in the end.
"""

import json
import os
import signal
import sys
import tempfile
from pathlib import Path

from harness import Child, Trial, forked
from killing import Points


def together(trial: Trial) -> dict:
    """The work by two processes."""
    folder = trial.place("shared")
    folder.mkdir()

    def first():
        points = Points(folder, len(trial.points) // 2, stop=True)
        points.install()
        trial.work.run(folder, lambda entry: None)
        return True

    child = Child(first)
    os.waitpid(child.pid, os.WUNTRACED)
    _, answer = Child(lambda: trial.work.run(folder, lambda entry: None)).wait()
    os.kill(child.pid, signal.SIGCONT)
    ended, own = child.wait()
    fault = None if ended == 0 else f"the first ended with {ended}: {own.get('error')}"
    if fault is None and forked(lambda: trial.work.result(folder)) != trial.result:
        fault = "another result"
    return {"work": trial.name, "first": child.pid, "second": answer.get("error"), "fault": fault}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="faults-") as place:
        for name in sys.argv[1:]:
            print(json.dumps(together(Trial(name, Path(place), False, False))), flush=True)
