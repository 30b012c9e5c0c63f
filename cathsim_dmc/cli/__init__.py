"""The command `cathsim`. Thin: every command imports what it needs when it runs."""

import os
import sys

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc.cli import agents
from cathsim_dmc.cli.measurements import benchmarks, validations
from cathsim_dmc.cli.options import BAD_INPUT, print_json
from cathsim_dmc.cli.phantoms import phantoms

_DESCRIPTION = "Autonomous endovascular navigation: train, evaluate, record, validate."

app = SubcommandApp()


@app.command(name="list")
def list_tasks(json: bool = False) -> int:
    """List the tasks, with one line each.

    Args:
        json: Print JSON instead of a table.
    """
    from rich.console import Console
    from rich.table import Table

    from cathsim_dmc import suite

    lines = {name: make.__doc__.splitlines()[0] for name, make in suite.SUITE.items()}
    if json:
        print_json({"domain": suite.DOMAIN, "tasks": lines})
        return 0
    table = Table("task", "what to do", box=None)
    for name, line in lines.items():
        table.add_row(name, line)
    Console().print(table)
    return 0


agents.add_to(app)
app.command(phantoms, name="phantom", help="Make, import and check anatomies.")
app.command(validations, name="validate", help="Compare the physics with theory.")
app.command(benchmarks, name="benchmark", help="Measure the speed.")


def main() -> None:
    """Runs the command line."""
    try:
        code = app.cli(
            prog="cathsim", description=_DESCRIPTION, config=(conf.OmitArgPrefixes,)
        )
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader, such as `head`, has seen enough; nor may the exit flush again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        # Errors with a message for the user; anything else is ours, with traceback.
        print(f"cathsim: {type(error).__name__}: {error}", file=sys.stderr)
        code = BAD_INPUT
    sys.exit(code)
