# The stub that tensordict ships imports its names from modules without types, so that
# to a type checker it exports nothing. What it exports is Any here.
from typing import Any

def __getattr__(name: str) -> Any: ...
