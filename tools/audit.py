"""Audit of the pinned dependencies: known holes, by pip-audit.

python tools/audit.py PIP_AUDIT CONSTRAINTS

Says how many packages a public database knew: one that it does not know has been
audited by nobody. Exit code 0: no hole is known, or no database can be reached, which
is said. Exit code 1: there are some.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

# Databases of pip-audit, in the order in which they are asked.
SERVICES = ("pypi", "osv")


def pins(constraints: str) -> list[str]:
    """Lines of a file of constraints that pin a version."""
    lines = Path(constraints).read_text().splitlines()
    return [line for line in lines if re.match(r"[\w.-]+==", line)]


def ask(pip_audit: str, listed: str, service: str) -> list[dict]:
    """What pip-audit says of each package; nothing where the database is not reached.

    Raises:
        RuntimeError: pip-audit itself failed.
    """
    done = subprocess.run(
        [pip_audit, "--no-deps", "--disable-pip", "--progress-spinner=off"]
        + ["--format=json", f"--vulnerability-service={service}", "-r", listed],
        capture_output=True,
        text=True,
        timeout=600,
    )
    try:
        return json.loads(done.stdout)["dependencies"]
    except ValueError:
        line = (done.stderr.strip() or "said nothing").splitlines()[-1]
        if re.search(r"usage:|unrecognized|invalid", done.stderr):
            raise RuntimeError(f"pip-audit: {line}") from None
        print(f"{service}: not reached ({line[:160]})")
        return []


def judge(found: list[dict], service: str) -> tuple[int, int]:
    """Prints what was found; numbers of packages audited and of holes."""
    audited = [one for one in found if "skip_reason" not in one]
    skipped = sorted(one["name"] for one in found if "skip_reason" in one)
    holes = 0
    for one in audited:
        for hole in one["vulns"]:
            holes += 1
            mended = ", ".join(hole.get("fix_versions") or ["no version"])
            print(f"{one['name']} {one['version']}: {hole['id']}, mended in {mended}")
    print(f"{service}: {len(audited)} of {len(found)} packages audited, {holes} holes")
    if audited and skipped:
        print(f"not audited: {', '.join(skipped)}")
    return len(audited), holes


def main(pip_audit: str, constraints: str) -> int:
    wanted = pins(constraints)
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as listed:
        listed.write("\n".join(wanted) + "\n")
        listed.flush()
        for service in SERVICES:
            audited, holes = judge(ask(pip_audit, listed.name, service), service)
            if audited:
                return 1 if holes else 0
    print(f"audit of {len(wanted)} packages skipped: no database knows any of them")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
