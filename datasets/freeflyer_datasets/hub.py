"""The Hugging Face hub: where a dataset lies there, reading its repository, and what went wrong."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoFile

_TIMEOUT = 60.0  # s; by default huggingface_hub waits for ever


class SharingError(ValueError):
    """A dataset was not shared; the message says why, and what to do."""


@dataclass(frozen=True)
class Place:
    """Where a dataset is on the hub.

    Attributes:
        dataset_id: Its id.
        repository: ``OWNER/NAME``.
        folder: Of the dataset in the repository; empty if the id has no namespace.
        namespaces: ``a`` and ``a/b`` of ``a/b/name-v0``.
    """

    dataset_id: str
    repository: str
    folder: str
    namespaces: tuple[str, ...]

    @classmethod
    def of(cls, dataset_id: str, remote: str | None) -> Place:
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage.remotes import DEFAULT_REMOTE

        try:
            parse_dataset_id(dataset_id)
        except (ValueError, TypeError):  # TypeError is Minari's for an id without a version.
            raise SharingError(
                f"{dataset_id!r} is no dataset id; give one like 'freeflyer/scene-1-v0'."
            ) from None
        address = remote or os.environ.get("MINARI_REMOTE") or DEFAULT_REMOTE
        match = re.fullmatch(r"hf://([\w.-]+)/?", address)
        if match is None:
            raise SharingError(
                f"{address!r} is no remote that can be used here; give remote='hf://OWNER', OWNER "
                f"being an account of Hugging Face, or set MINARI_REMOTE to it."
            )
        parts = PurePosixPath(dataset_id).parts
        namespaces = tuple("/".join(parts[: end + 1]) for end in range(len(parts) - 1))
        return cls(dataset_id, f"{match[1]}/{parts[0]}", "/".join(parts[1:]), namespaces)

    def path(self, name: str) -> str:
        """Path in the repository of a file of the dataset."""
        return f"{self.folder}/{name}" if self.folder else name


@dataclass(frozen=True)
class Repository:
    """A repository at one commit."""

    api: HfApi
    name: str
    commit: str
    files: dict[str, RepoFile]

    @classmethod
    def at_head(cls, api: HfApi, place: Place) -> Repository:
        from huggingface_hub.hf_api import RepoFile

        commit = api.dataset_info(place.repository, timeout=_TIMEOUT).sha
        assert commit is not None
        entries = api.list_repo_tree(
            place.repository, recursive=True, revision=commit, repo_type="dataset"
        )
        files = {entry.path: entry for entry in entries if isinstance(entry, RepoFile)}
        return cls(api, place.repository, commit, files)

    @cached_property
    def _file_system(self) -> Any:
        from huggingface_hub import HfFileSystem

        token, endpoint = self.api.token, self.api.endpoint
        return HfFileSystem(token=token, endpoint=endpoint, skip_instance_cache=True)

    def open(self, path: str) -> Any:
        """A file that reads exactly the bytes asked for, each time with a request."""
        address = f"datasets/{self.name}@{self.commit}/{path}"
        size = self.files[path].size
        return self._file_system.open(address, "rb", cache_type="none", size=size)

    def text(self, path: str) -> str | None:
        """A small file's content, None if there is no such file."""
        # Not hf_hub_download: Minari edits the files in that cache.
        if path not in self.files:
            return None
        with self.open(path) as file:
            return bytes(file.read(self.files[path].size)).decode()


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turns every failure into a :class:`SharingError` of one line with a remedy."""
    try:
        yield
    except SharingError:
        raise
    except ImportError as error:
        package = (error.name or str(error)).partition(".")[0]
        raise SharingError(
            f"{what}: {package} is missing. pip install 'freeflyer-gym[data]' huggingface-hub"
        ) from error
    except Exception as error:
        if reason := _reason(error):
            raise SharingError(f"{what}: {reason}") from error
        raise


def _reason(error: Exception) -> str | None:
    """What failed, by the first error of the chain that tells; None for what should not occur."""
    cause: BaseException | None = error
    while cause is not None:
        if reason := _reason_of_hub(cause):
            return reason
        cause = cause.__cause__
    if isinstance(error, (OSError, ValueError, RuntimeError)):
        return f"{_first_line(error)}. What is done is kept; put that right and call it again."
    return None


def _reason_of_hub(error: BaseException) -> str | None:
    # By name: the HTTP library beneath huggingface_hub has changed, and will again.
    names = {kind.__name__ for kind in type(error).__mro__}
    status = getattr(getattr(error, "response", None), "status_code", None)
    if "OfflineModeIsEnabled" in names:
        return "HF_HUB_OFFLINE is set. Unset it, and call it again."
    if names & {"TransportError", "TimeoutException", "ConnectionError", "Timeout"}:
        return (
            f"Hugging Face cannot be reached ({_first_line(error)}). Check the connection and call "
            f"it again: it goes on where it stopped."
        )
    if "RepositoryNotFoundError" in names:
        return (
            "there is no such repository on Hugging Face, or it is private. Check the id and "
            "remote='hf://OWNER'; if it is private, the token too ('hf auth login' or HF_TOKEN)."
        )
    if status == 401:
        return (
            "Hugging Face does not accept the token, or there is none. Log in with "
            "'hf auth login', or set HF_TOKEN."
        )
    if status == 403:
        return (
            "the token does not permit that. Use one with write access, and an account of yours "
            "as remote='hf://OWNER' or MINARI_REMOTE."
        )
    if status in (409, 412):
        return "the repository has changed in the meantime. Call it again."
    if status is not None:
        return f"Hugging Face says {_first_line(error)!r}. Call it again later: it goes on."
    return None


def _first_line(error: BaseException) -> str:
    text = getattr(error, "server_message", None) or str(error)
    lines = text.strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


@contextmanager
def progress_bars(shown: bool) -> Iterator[None]:
    """Without the bars of huggingface_hub, unless they are to be shown."""
    from huggingface_hub import utils

    if shown or utils.are_progress_bars_disabled():
        yield
        return
    utils.disable_progress_bars()
    try:
        yield
    finally:
        utils.enable_progress_bars()
