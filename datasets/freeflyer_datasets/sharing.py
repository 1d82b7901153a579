"""Sharing: datasets on Minari's remote, a Hugging Face account, there and back.

The layout is Minari's, so ``minari.download_dataset`` reads it too: the first part of an id is a
repository of the account, the rest a folder of it::

    hf://OWNER                      the remote
      freeflyer                     repository
        README.md                   its page, with the cards of all its datasets
        namespace_metadata.json     the list of them
        scene-1-v0                  README.md, SHA256SUMS and data
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from freeflyer_datasets.hub import Place, Repository, SharingError, explained, progress_bars
from freeflyer_datasets.packing import describe_file

if TYPE_CHECKING:
    from huggingface_hub.hf_api import RepoFile

#: Checksums of the files in ``data``, as ``sha256sum`` writes and checks them.
MANIFEST_NAME = "SHA256SUMS"

_CARD_NAME = "README.md"
_METADATA_NAME = "data/metadata.json"
_NAMESPACE_NAME = "namespace_metadata.json"
_BLOCK_BYTES = 32 * 2**20


def upload(
    dataset_id: str,
    *,
    remote: str | None = None,
    token: str | None = None,
    progress: bool = True,
) -> str:
    """Pushes a dataset with its card and checksums to Hugging Face.

    Namespace first, then the data, and the entry in the list last. Interrupted, it goes on when
    called again: ``huggingface_hub.HfApi.upload_folder`` compares hashes and does not send again
    what the hub has, whole files or, with ``hf_xet``, parts of them. What it replaces stays in
    the repository's history.

    Args:
        dataset_id: A dataset of this machine, such as ``"freeflyer/scene-1-v0"``.
        remote: As ``"hf://OWNER"``; that of ``MINARI_REMOTE`` or Minari's own if None.
        token: With write access; ``HF_TOKEN`` or that of ``hf auth login`` if None.
        progress: Whether to show progress bars.

    Returns:
        The address of the repository.

    Raises:
        SharingError: If it cannot be pushed. Of the local dataset only ``SHA256SUMS`` changes.
    """
    with explained(f"{dataset_id!r} was not uploaded"), progress_bars(progress):
        from huggingface_hub import HfApi

        place = Place.of(dataset_id, remote)
        folder = _local_dataset(dataset_id)
        _write_manifest(folder)
        api = HfApi(token=token)
        api.create_repo(place.repository, repo_type="dataset", exist_ok=True)
        repository = Repository.at_head(api, place)
        _publish(repository, _namespace_files(repository, place), f"Namespace of {dataset_id}")
        api.upload_folder(
            repo_id=place.repository,
            repo_type="dataset",
            folder_path=folder,
            path_in_repo=place.folder,
            # Not the packed form, a cache.
            allow_patterns=["data/*", "*.png", _CARD_NAME, MANIFEST_NAME],
            delete_patterns=["data/*", "*.png"],
            commit_message=f"Upload {dataset_id}",
        )
        repository = Repository.at_head(api, place)
        files = _namespace_files(repository, place, listed=True)
        if place.namespaces and (folder / _CARD_NAME).is_file():
            card = (folder / _CARD_NAME).read_text(encoding="utf-8")
            # The page lies a folder above the card and its pictures.
            card = re.sub(r"\]\((\w+\.png)\)", rf"]({place.folder}/\1)", card)
            files[_CARD_NAME] = _page(repository.text(_CARD_NAME), dataset_id, card)
        _publish(repository, files, f"List {dataset_id}")
        return f"{api.endpoint}/datasets/{place.repository}"


def download(
    dataset_id: str,
    *,
    remote: str | None = None,
    force: bool = False,
    progress: bool = True,
) -> Path:
    """Fetches a dataset from Hugging Face into Minari's data root, and checks it.

    It is fetched into a hidden folder beside its own, which it takes when every checksum is right.
    Interrupted, it goes on when called again: finished files are kept, and an unfinished one is
    continued where it stopped. Private ones need ``HF_TOKEN`` or ``hf auth login``.

    Args:
        dataset_id: Such as ``"freeflyer/scene-1-v0"``.
        remote: As ``"hf://OWNER"``; that of ``MINARI_REMOTE`` or Minari's own if None.
        force: Whether to replace a dataset of the same id.
        progress: Whether to show a progress bar.

    Returns:
        Its folder; ``minari.load_dataset(dataset_id)`` opens it.

    Raises:
        SharingError: If it cannot be fetched, is damaged, or a dataset of this id is here and
            ``force`` is not set. A dataset that was here stays then.
    """
    with explained(f"{dataset_id!r} was not downloaded"), progress_bars(progress):
        from huggingface_hub import HfApi

        from freeflyer_datasets.storage import dataset_folder

        place = Place.of(dataset_id, remote)
        target = dataset_folder(dataset_id)
        if target.exists() and not force:
            raise SharingError(
                f"A dataset {dataset_id!r} is already in {str(target)!r}. Set force=True to "
                f"replace it, or MINARI_DATASETS_PATH to another folder."
            )
        repository = Repository.at_head(HfApi(), place)
        files = _files_of(repository, place)
        _check_metadata(repository, place)
        temporary = target.with_name(f".{target.name}.download")
        _fetch(repository, files, temporary, target, progress)
        _create_namespace(repository, place)
        _install(temporary, target)
        return target


def _local_dataset(dataset_id: str) -> Path:
    from freeflyer_datasets.storage import dataset_folder

    folder = dataset_folder(dataset_id)
    try:
        found = json.loads((folder / _METADATA_NAME).read_text(encoding="utf-8"))["dataset_id"]
    except FileNotFoundError:
        raise SharingError(
            f"There is no dataset {dataset_id!r} in {str(folder)!r}. Make it with "
            f"freeflyer_datasets.build, or set MINARI_DATASETS_PATH to where it lies."
        ) from None
    if found != dataset_id:
        raise SharingError(
            f"{str(folder)!r} holds the dataset {found!r}, not {dataset_id!r}. Rename the folder."
        )
    return folder


def _write_manifest(folder: Path) -> None:
    paths = sorted(path for path in (folder / "data").rglob("*") if path.is_file())
    lines = [
        f"{describe_file(path)['sha256']}  {path.relative_to(folder).as_posix()}\n"
        for path in paths
    ]
    temporary = folder / f"{MANIFEST_NAME}.{os.getpid()}.tmp"
    temporary.write_text("".join(lines), encoding="utf-8")
    temporary.replace(folder / MANIFEST_NAME)


def _read_manifest(text: str | None) -> dict[str, str]:
    """Checksums by name; none without a manifest, as in datasets that Minari uploaded."""
    lines = (text or "").splitlines()
    return {name: checksum for checksum, _, name in (line.partition("  ") for line in lines)}


def _namespace_files(repository: Repository, place: Place, listed: bool = False) -> dict[str, str]:
    """The files that describe the namespaces, what the hub knows of them being kept."""
    from minari.namespace import get_namespace_metadata, list_local_namespaces

    local = list_local_namespaces()
    files = {}
    for namespace in place.namespaces:
        path = "/".join([*namespace.split("/")[1:], _NAMESPACE_NAME])
        text = repository.text(path)
        if text is not None:
            content = json.loads(text)
        else:
            content = dict(get_namespace_metadata(namespace)) if namespace in local else {}
            content.pop("datasets", None)
            content.pop("namespaces", None)
        if namespace == place.namespaces[0]:
            _extend(content, "namespaces", place.namespaces[1:])
            _extend(content, "datasets", (place.dataset_id,) if listed else ())
        files[path] = json.dumps(content)
    return files


def _extend(content: dict[str, Any], key: str, items: tuple[str, ...]) -> None:
    if items:
        content[key] = sorted({*content.get(key, []), *items})


def _page(page: str | None, dataset_id: str, card: str) -> str:
    """The page of a repository with the card of a dataset put in; the rest of it is kept."""
    match = re.match(r"---\n.*?\n---\n", card, re.DOTALL)
    head = match[0] if match else ""
    first, last = f"<!-- {dataset_id} -->", f"<!-- end of {dataset_id} -->"
    section = f"{first}\n{card[len(head) :].strip()}\n{last}"
    page = (page or "").replace("\r\n", "\n")
    if not page.startswith("---\n"):
        page = head + page
    before, found, rest = page.partition(first)
    if not found:
        return f"{page.rstrip()}\n\n{section}\n"
    _, found, after = rest.partition(last)
    return f"{before}{section}{after if found else rest}"


def _publish(repository: Repository, files: dict[str, str], message: str) -> None:
    """Commits those of the files, by path in the repository, that differ from the hub's."""
    from huggingface_hub import CommitOperationAdd

    changed = {path: text for path, text in files.items() if repository.text(path) != text}
    if changed:
        repository.api.create_commit(
            repository.name,
            [CommitOperationAdd(path, text.encode()) for path, text in changed.items()],
            commit_message=message,
            repo_type="dataset",
            # Fails rather than loses what another upload has listed at the same time.
            parent_commit=repository.commit,
        )


def _files_of(repository: Repository, place: Place) -> dict[str, tuple[RepoFile, str | None]]:
    """The dataset's files by name, each with its SHA-256 where that is known."""
    prefix = place.path("")
    names = {
        path.removeprefix(prefix): entry
        for path, entry in repository.files.items()
        if path.startswith(prefix)
    }
    if _METADATA_NAME not in names:
        listed = json.loads(repository.text(_NAMESPACE_NAME) or "{}").get("datasets", [])
        raise SharingError(
            f"There is no dataset {place.dataset_id!r} in {repository.name!r} of Hugging Face, or "
            f"its upload is unfinished. There are: {', '.join(sorted(listed)) or 'none'}."
        )
    manifest = _read_manifest(repository.text(place.path(MANIFEST_NAME)))
    if missing := sorted(set(manifest) - set(names)):
        raise SharingError(
            f"The upload of {place.dataset_id!r} is unfinished: {', '.join(missing)} is missing. "
            f"Have it uploaded again."
        )
    return {
        name: (entry, manifest.get(name) or (entry.lfs.sha256 if entry.lfs else None))
        for name, entry in names.items()
        if name.startswith("data/")
        or name in (_CARD_NAME, MANIFEST_NAME)
        or ("/" not in name and name.endswith(".png"))
    }


def _check_metadata(repository: Repository, place: Place) -> None:
    import minari

    metadata = json.loads(repository.text(place.path(_METADATA_NAME)) or "{}")
    version = metadata.get("minari_version")
    if version not in minari.supported_dataset_versions:
        raise SharingError(
            f"{place.dataset_id!r} is of Minari {version}, which Minari {minari.__version__} does "
            f"not read. pip install --upgrade minari"
        )


def _fetch(
    repository: Repository,
    files: dict[str, tuple[RepoFile, str | None]],
    folder: Path,
    target: Path,
    progress: bool,
) -> None:
    """Completes ``folder``, which may hold what an interrupted download has left."""
    from tqdm import tqdm

    parts = {f"{name}.{entry.blob_id[:12]}.part" for name, (entry, _) in files.items()}
    folder.mkdir(parents=True, exist_ok=True)
    present = 0
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        if path.relative_to(folder).as_posix() in files.keys() | parts:
            present += path.stat().st_size
        else:
            path.unlink()
    size = sum(entry.size for entry, _ in files.values())
    if size - present > (free := shutil.disk_usage(folder).free):
        raise SharingError(
            f"It needs {(size - present) / 1e9:.1f} GB in {str(target.parent)!r}, where "
            f"{free / 1e9:.1f} GB are free. Make room, or set MINARI_DATASETS_PATH elsewhere."
        )
    damaged = []
    with tqdm(total=size, unit="B", unit_scale=True, disable=not progress, desc="download") as bar:
        for name, (entry, checksum) in files.items():
            path = folder / name
            if not _is_sound(path, entry, checksum):
                _fetch_file(repository, entry, path, bar)
                if not _is_sound(path, entry, checksum):
                    path.unlink()
                    damaged.append(name)
            else:
                bar.update(entry.size)
    if damaged:
        raise SharingError(
            f"The checksum of {', '.join(damaged)} is wrong, the rest is kept. Call it again; if "
            f"that does not help, have the dataset uploaded again."
        )


def _fetch_file(repository: Repository, entry: RepoFile, path: Path, bar: Any) -> None:
    # Not hf_hub_download, which starts again with a file of many GB when it is interrupted.
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{entry.blob_id[:12]}.part")
    with open(part, "ab") as sink, repository.open(entry.path) as source:
        position = sink.tell()
        source.seek(position)
        bar.update(position)
        while position < entry.size:
            wanted = min(_BLOCK_BYTES, entry.size - position)
            block = source.read(wanted)
            if len(block) != wanted:
                raise OSError(f"Hugging Face sent {len(block)} bytes of {path.name}, not {wanted}.")
            sink.write(block)
            position += wanted
            bar.update(wanted)
    part.replace(path)


def _is_sound(path: Path, entry: RepoFile, checksum: str | None) -> bool:
    if not path.is_file() or path.stat().st_size != entry.size:
        return False
    if checksum is not None:
        return bool(describe_file(path)["sha256"] == checksum)
    # Of a small file outside the manifest, such as the card, only Git's hash is known.
    content = path.read_bytes()
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest() == entry.blob_id


def _create_namespace(repository: Repository, place: Place) -> None:
    from minari.namespace import create_namespace, list_local_namespaces

    if place.namespaces and place.namespaces[-1] not in list_local_namespaces():
        path = "/".join([*place.namespaces[-1].split("/")[1:], _NAMESPACE_NAME])
        content = json.loads(repository.text(path) or "{}")
        create_namespace(place.namespaces[-1], description=content.get("description"))


def _install(folder: Path, target: Path) -> None:
    """Puts a folder in the place of another, which comes back if that fails."""
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        target.rename(old)
    try:
        folder.rename(target)
    except OSError:
        if old.exists():
            old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)
