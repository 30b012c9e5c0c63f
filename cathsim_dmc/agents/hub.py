"""Policies and datasets on the Hugging Face Hub: `hf:OWNER/NAME@COMMIT`.

Policies are safetensors with a card in JSON, datasets HDF5 or .npz: no file that can
run code is downloaded. Downloads are pinned to a commit and kept in the hub's cache,
which is also read without a network.
"""

import contextlib
import re
from pathlib import Path
from typing import Any, NamedTuple

from cathsim_dmc import extras, files

PREFIX = "hf:"
_FORM = re.compile(
    r"hf:(?P<repository>[\w.-]+/[\w.-]+)(@(?P<commit>[0-9a-f]{40}))?(#(?P<name>[\w-]+))?"
)
# Files of a dataset that are downloaded, by their paths in the repository.
_DATASET = ("data/*.hdf5", "data/metadata.json", "*.npz")


class Reference(NamedTuple):
    """Parts of a text such as hf:OWNER/NAME@COMMIT#POLICY.

    Attributes:
        repository: "OWNER/NAME".
        commit: 40 hexadecimal digits; None if none is given.
        name: Name of the policy in the repository; by default that of the repository.
    """

    repository: str
    commit: str | None
    name: str


def is_reference(text: str | Path) -> bool:
    """Whether a text names something on the hub."""
    return str(text).startswith(PREFIX)


def parse(text: str, pinned: bool = True) -> Reference:
    """Parse a reference; ValueError for another form, or unless it is as `pinned`.

    Args:
        text: The reference.
        pinned: Whether it must have a commit; otherwise it must have none.
    """
    found = _FORM.fullmatch(text)
    if found is None:
        form = "hf:OWNER/NAME, without a commit, which the upload makes,"
        if pinned:
            form = "hf:OWNER/NAME@COMMIT, with 40 hexadecimal digits,"
        raise ValueError(
            f"{text} is no repository on the hub; give {form} and #POLICY where the "
            "repository holds several"
        )
    parts = found.groupdict()
    if pinned and parts["commit"] is None:
        raise ValueError(
            f"{text} names no commit, so its content may change; give "
            f"{text.partition('#')[0]}@ and the 40 digits that `cathsim upload` "
            "printed, or that its page shows under Files, History"
        )
    if not pinned and parts["commit"] is not None:
        raise ValueError(f"{text}: an upload makes a commit of its own; leave @… out")
    name = parts["name"] or parts["repository"].partition("/")[2]
    return Reference(parts["repository"], parts["commit"], name)


def policy(text: str) -> Path:
    """Download a policy; return the path of its weights, with its card beside them.

    Raises:
        ValueError: the text is no reference, or the hub has no such policy.
        ModuleNotFoundError: the extra `hub` is not installed.
    """
    place = parse(text)
    extras.require("hub", "huggingface_hub")
    from huggingface_hub import hf_hub_download

    def fetch(suffix: str) -> Path:
        file = f"{place.name}{suffix}"
        with _named(text, file):
            return Path(hf_hub_download(place.repository, file, revision=place.commit))

    card = fetch(".json")
    weights = fetch(".safetensors")
    if card.parent != weights.parent:
        raise ValueError(f"{text}: weights and card are not of one commit")
    return weights


def dataset(text: str) -> Path:
    """Download a dataset; return its directory; raises as `policy`."""
    place = parse(text)
    extras.require("hub", "huggingface_hub")
    from huggingface_hub import snapshot_download

    with _named(text, "data"):
        folder = snapshot_download(
            place.repository,
            repo_type="dataset",
            revision=place.commit,
            allow_patterns=list(_DATASET),
        )
    return Path(folder)


def upload(folder: Path, text: str, kind: str, private: bool = True) -> str:
    """Upload a folder.

    Args:
        folder: Files to upload; others in the repository stay.
        text: "hf:OWNER/NAME"; the repository is made where there is none.
        kind: "model" or "dataset".
        private: Whether a repository that is made is private.

    Returns:
        The reference of the upload, with its commit.

    Raises:
        ValueError: the text is no reference, or the hub refuses.
        ModuleNotFoundError: the extra `hub` is not installed.
    """
    place = parse(text, pinned=False)
    extras.require("hub", "huggingface_hub")
    from huggingface_hub import HfApi

    api = HfApi()
    where: Any = {"repo_id": place.repository, "repo_type": kind}
    with _named(text, "upload"):
        api.create_repo(**where, private=private, exist_ok=True)
        done = api.upload_folder(
            **where, folder_path=str(folder), commit_message="Upload by cathsim_dmc"
        )
    return f"{PREFIX}{place.repository}@{done.oid}"


def _named(text: str, what: str) -> contextlib.AbstractContextManager[None]:
    """Raise errors of the hub's client, which are of many kinds, as ValueError."""
    return files.refused(ValueError, f"{text}, {what}", Exception)
