"""Table of the files that `legged evaluate onnx --rmse` wrote: `python docs/peers/table.py mjlab_go1.json ...`."""

import json
import sys
from pathlib import Path
from typing import Any


def main() -> None:
    """Print a line for each file."""
    print("| training | iterations/s | seconds until followed | velocity RMSE at the end | worst cell | yaw RMSE | falls |")
    print("|---|---|---|---|---|---|---|")
    for path in map(Path, sys.argv[1:]):
        result = json.loads(path.read_text())
        rows, first = result["policies"], result["first"]
        last = rows[-1]
        cells = [
            path.stem,
            rate(rows),
            f"{first['wall_s']:.0f} ({first['iterations']:.0f} iterations)" if first else f"not in {last['wall_s']:.0f}",
            number(last["rmse_lin"]["mean"]),
            number(last["rmse_lin"]["worst"]),
            number(last["rmse_ang"]["mean"]),
            f"{100 * last['falls']:.0f} %",
        ]
        print(f"| {' | '.join(cells)} |")


def rate(rows: list[dict[str, Any]]) -> str:
    """Return iterations per second between the first checkpoint and the last; times robots and steps of an iteration, these
    are training steps per second.
    """
    done = rows[-1]["iterations"] - rows[0]["iterations"]
    return f"{done / (rows[-1]['wall_s'] - rows[0]['wall_s']):.2f}" if done else "-"


def number(value: float | None) -> str:
    """Return a figure; "-" where every robot fell before it could be measured."""
    return "-" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
