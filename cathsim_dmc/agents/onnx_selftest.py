"""Self-test of a policy as ONNX; needs numpy and onnxruntime alone.

python selftest.py [FOLDER]

Runs policy.onnx on the observations of an episode in selftest.npz and compares its
actions with those of the policy itself. Exit code 1: they differ.
"""

import json
import sys
from pathlib import Path

import numpy as np

MODEL, CARD, SAMPLES = "policy.onnx", "card.json", "selftest.npz"


def differences(folder):
    """Return the largest difference of an action at each step, (T,)."""
    import onnxruntime

    folder = Path(folder)
    session = onnxruntime.InferenceSession(
        str(folder / MODEL), providers=["CPUExecutionProvider"]
    )
    with np.load(folder / SAMPLES, allow_pickle=False) as held:
        samples = dict(held)
    expected = samples.pop("action")
    rows = []
    for step in range(len(expected)):  # one by one, as on a robot
        given = {name: array[step : step + 1] for name, array in samples.items()}
        (action,) = session.run(["action"], given)
        rows.append(np.abs(action[0] - expected[step]).max())
    return np.array(rows)


def main():
    """Print the largest difference; exit with 1 where it is too large."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else __file__).resolve()
    folder = folder if folder.is_dir() else folder.parent
    allowed = json.loads((folder / CARD).read_text())["self_test"]["tolerance"]
    found = differences(folder)
    good = bool(found.max() <= allowed)
    word = "agrees" if good else "DIFFERS"
    largest = f"largest difference {found.max():.1e} (at most {allowed:g})"
    print(f"{word}: {len(found)} actions, {largest}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
