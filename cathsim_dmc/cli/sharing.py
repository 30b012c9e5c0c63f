"""`cathsim upload`."""

from pathlib import Path
from typing import Annotated

from tyro import conf

# torchrl goes before dm_control.
from cathsim_dmc import agents  # noqa: F401  isort: skip

from cathsim_dmc.agents import sharing


def upload(
    source: Annotated[str, conf.Positional],
    place: Annotated[str, conf.Positional],
    /,
    public: bool = False,
) -> int:
    """Upload a policy or a dataset to the Hugging Face Hub; print its reference.

    Log in before (`hf auth login`). Extra `hub`.

    Args:
        source: Directory of a run or checkpoint, pretrained:NAME or a .safetensors
            file; or the directory of a dataset of `cathsim demos`, or of episodes of
            `cathsim play`.
        place: hf:OWNER/NAME; the repository is created if it does not exist.
        public: Whether a repository that is created is public.
    """
    given = Path(source) if Path(source).exists() else source
    print(sharing.upload(given, place, private=not public))
    return 0
