"""Writes requirements.lock: every package of the base and of the tests at one version.

    python tools/lock.py [UV]

uv finds versions that suit all Pythons and systems within constraints.txt. Two kinds of
packages are left out, so `pip install --no-deps` installs the file: labmaze, which
dm-control requires but nothing here imports, and packages for CUDA.
"""

import argparse
import re
import subprocess
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements.lock"
HEAD = """\
# Every package of the base and of the tests, written by `make lock`. Install it with
#   pip install --no-deps -r requirements.lock
# and, where the index has torch with CUDA, with its CPU build before:
#   --extra-index-url https://download.pytorch.org/whl/cpu
"""
LEFT_OUT = re.compile(r"(labmaze|nvidia-|cuda-|numba-cuda|triton)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("uv", nargs="?", default="uv", help="the program uv")
    uv = parser.parse_args().uv
    with tempfile.TemporaryDirectory() as folder:
        override, out = Path(folder) / "override.txt", Path(folder) / "lock.txt"
        override.write_text("labmaze ; python_version < '3'\n")
        command = [uv, "pip", "compile", "--no-config", "pyproject.toml"]
        command += ["--extra", "test", "--universal", "--python-version", "3.11"]
        command += ["-c", "constraints.txt", "--override", str(override), "--quiet"]
        command += ["--no-emit-index-url", "--no-emit-find-links", "--no-header"]
        subprocess.run(
            [*command, "--no-annotate", "-o", str(out)], cwd=ROOT, check=True
        )
        lines = out.read_text().splitlines()
    kept = [line for line in lines if not LEFT_OUT.match(line)]
    LOCK.write_text(HEAD + "\n".join(kept) + "\n")
    print(f"{LOCK.name}: {len(kept)} packages")


if __name__ == "__main__":
    main()
