"""Audit of the pinned dependencies: known holes, by pip-audit.

python tools/audit.py PIP_AUDIT CONSTRAINTS

Exit code 0: none is known, or the database cannot be reached, which is said. Exit code
1: there are some.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

# What pip-audit says when it could not ask.
_UNREACHED = re.compile(
    r"ConnectionError|Max retries|Failed to establish|timed out|service error|"
    r"NameResolution|Service Unavailable|ServiceError|40[34]|Forbidden",
    re.IGNORECASE,
)


def main(pip_audit: str, constraints: str) -> int:
    lines = Path(constraints).read_text().splitlines()
    pins = [line for line in lines if re.match(r"[\w.-]+==", line)]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as listed:
        listed.write("\n".join(pins) + "\n")
        listed.flush()
        done = subprocess.run(
            [pip_audit, "--no-deps", "--disable-pip", "-r", listed.name],
            capture_output=True,
            text=True,
            timeout=600,
        )
    print(done.stdout, end="")
    if done.returncode and not done.stdout and _UNREACHED.search(done.stderr):
        print(f"audit of {len(pins)} packages skipped: no database can be reached")
        return 0
    print(done.stderr, end="", file=sys.stderr)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
