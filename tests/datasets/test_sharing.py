"""Sharing over the hub: huggingface_hub's own client against a small hub in memory."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from freeflyer_datasets import Recipe, sharing
from freeflyer_datasets.export import export
from freeflyer_datasets.sharing import MANIFEST_NAME, SharingError, download, upload

minari = pytest.importorskip("minari")
huggingface_hub = pytest.importorskip("huggingface_hub")
http_of_hub = pytest.importorskip("huggingface_hub.utils._http")
http = pytest.importorskip("httpx2")

# Of the client's upload without Xet.
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=<...>':DeprecationWarning")

DATASET = "freeflyer/tiny-v0"
REMOTE = "hf://me"
ADDRESS = "https://huggingface.co/datasets/me/freeflyer"
DATA = "tiny-v0/data/main_data.hdf5"
FILES = [
    *("tiny-v0/README.md", f"tiny-v0/{MANIFEST_NAME}"),
    *(DATA, "tiny-v0/data/metadata.json"),
    *("tiny-v0/histograms.png", "tiny-v0/trajectories.png"),
]


class Hub:
    """Repositories as lists of commits, each a dictionary of files; `.hdf5` go by LFS."""

    def __init__(self) -> None:
        self.repositories: dict[str, list[dict[str, bytes]]] = {}
        self.messages: list[str] = []
        self.large: dict[str, bytes] = {}
        self.received: Counter[str] = Counter()  # bytes of large files by hash
        self.served: Counter[str] = Counter()  # bytes by path
        self.damaged: set[str] = set()
        self.refuse: Callable[[http.Request], int | None] = lambda request: None

    @property
    def files(self) -> dict[str, bytes]:
        return self.repositories["me/freeflyer"][-1]

    def __call__(self, request: http.Request) -> http.Response:
        status = self.refuse(request)
        if status is not None:
            return http.Response(status, json={"error": "as a test"})
        if request.headers.get("authorization") not in (None, "Bearer good"):
            return http.Response(
                401, headers={"X-Error-Message": "Invalid credentials in Authorization header"}
            )
        path = request.url.path
        if path == "/api/repos/create":
            return self.create(json.loads(request.read()))
        if path == "/api/validate-yaml":
            return http.Response(200, json={"errors": [], "warnings": []})
        if match := re.fullmatch("/store/(.+)", path):
            self.large[match[1]] = request.read()
            self.received[match[1]] += len(self.large[match[1]])
            return http.Response(200)
        if path == "/api/datasets":
            return http.Response(200, json=[{"id": name} for name in self.repositories])
        match = re.fullmatch(r"/(?:api/)?datasets/([\w-]+/[\w-]+)(?:\.git/|/)?(\w*)/?(.*)", path)
        assert match is not None, path
        name, action, rest = match.groups()
        if name not in self.repositories:
            return http.Response(401, headers={"X-Error-Code": "RepoNotFound"})
        commits = self.repositories[name]
        if action in ("", "revision"):
            return http.Response(200, json={"id": name, "sha": f"{len(commits) - 1:040x}"})
        if action == "tree":
            prefix = "/".join([*rest.split("/")[1:], ""]) if "/" in rest else ""
            entries = [
                entry(path, content)
                for path, content in self.tree(name, rest).items()
                if path.startswith(prefix)
            ]
            return http.Response(200, json=entries)
        if action == "preupload":
            return self.preupload(commits[-1], json.loads(request.read())["files"])
        if action == "info":
            wanted = json.loads(request.read())["objects"]
            return http.Response(200, json={"objects": [self.store(item) for item in wanted]})
        if action == "commit":
            lines = [json.loads(line) for line in request.read().splitlines()]
            return self.commit(commits, lines)
        assert action == "resolve"
        return self.resolve(request, name, rest)

    def create(self, wanted: dict) -> http.Response:
        name = f"{wanted['organization']}/{wanted['name']}"
        if wanted["organization"] != "me":
            return http.Response(403, json={"error": "no rights"})
        if name in self.repositories:
            return http.Response(409, json={"url": f"https://huggingface.co/datasets/{name}"})
        self.repositories[name] = [{".gitattributes": b"*.hdf5 filter=lfs"}]
        return http.Response(200, json={"url": f"https://huggingface.co/datasets/{name}"})

    def tree(self, name: str, rest: str) -> dict[str, bytes]:
        revision = rest.split("/")[0]
        return self.repositories[name][-1 if revision == "main" else int(revision, 16)]

    def preupload(self, files: dict[str, bytes], wanted: list[dict]) -> http.Response:
        answers = [
            {
                "path": item["path"],
                "uploadMode": "lfs" if item["path"].endswith(".hdf5") else "regular",
                "shouldIgnore": False,
                "oid": digest(item["path"], files[item["path"]]) if item["path"] in files else None,
            }
            for item in wanted
        ]
        return http.Response(200, json={"files": answers})

    def store(self, item: dict) -> dict:
        if item["oid"] in self.large:
            return item
        return {**item, "actions": {"upload": {"href": f"https://hub.test/store/{item['oid']}"}}}

    def commit(self, commits: list[dict[str, bytes]], lines: list[dict]) -> http.Response:
        files = dict(commits[-1])
        for line in lines:
            value = line["value"]
            if line["key"] == "header":
                self.messages.append(value["summary"])
                if value.get("parentCommit", f"{len(commits) - 1:040x}") != (
                    f"{len(commits) - 1:040x}"
                ):
                    return http.Response(412, json={"error": "not the parent"})
            elif line["key"] == "deletedFile":
                del files[value["path"]]
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.large[value["oid"]]
            else:
                files[value["path"]] = base64.b64decode(value["content"])
        commits.append(files)
        answer = {"commitUrl": f"{ADDRESS}/commit/1", "commitOid": "1"}
        return http.Response(200, json=answer)

    def resolve(self, request: http.Request, name: str, rest: str) -> http.Response:
        path = rest.split("/", 1)[1]
        content = self.tree(name, rest).get(path)
        commit = {"X-Repo-Commit": f"{len(self.repositories[name]) - 1:040x}"}
        if content is None:
            return http.Response(404, headers={"X-Error-Code": "EntryNotFound", **commit})
        headers = {"ETag": digest(path, content), **commit}
        if request.method == "HEAD":
            return http.Response(200, headers={**headers, "Content-Length": str(len(content))})
        if span := re.fullmatch(r"bytes=(\d+)-(\d+)", request.headers.get("range", "")):
            content = content[int(span[1]) : int(span[2]) + 1]
        self.served[path] += len(content)
        if path in self.damaged:
            content = b"?" + content[1:]
        return http.Response(206 if span else 200, headers=headers, content=content)


def digest(path: str, content: bytes) -> str:
    if path.endswith(".hdf5"):
        return hashlib.sha256(content).hexdigest()
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def entry(path: str, content: bytes) -> dict:
    about = {"type": "file", "path": path, "size": len(content), "oid": digest(path, content)}
    if not path.endswith(".hdf5"):
        return about
    return {**about, "lfs": {"oid": about["oid"], "size": len(content), "pointerSize": 130}}


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An empty hub, to which huggingface_hub talks; only the account `me` may write."""
    hub = Hub()
    monkeypatch.setenv("HF_TOKEN", "good")
    monkeypatch.delenv("MINARI_REMOTE", raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(sharing, "_BLOCK_BYTES", 20_000)
    huggingface_hub.set_client_factory(
        lambda: http.Client(transport=http.MockTransport(hub), follow_redirects=True)
    )
    yield hub
    huggingface_hub.set_client_factory(http_of_hub.default_client_factory)


@pytest.fixture(scope="module")
def exported(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with a dataset of three problems; tests must not change it."""
    root = tmp_path_factory.mktemp("exported")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        patch.setattr("freeflyer_datasets.export._N_REFERENCE_EPISODES", 2)
        export(shards, n_problems=3)
    return root


@pytest.fixture
def source(exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The data root of who uploads: a copy, with the packed form beside the data."""
    root = tmp_path / "source"
    shutil.copytree(exported, root)
    (root / DATASET / "packed").mkdir()
    (root / DATASET / "packed" / "meta.json").write_text("{}")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    return root


@pytest.fixture
def uploaded(hub: Hub, source: Path, data_root: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
    """The hub with the dataset; Minari's data root is another, empty one."""
    upload(DATASET, remote=REMOTE, progress=False)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(data_root))
    return hub


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_round_trip(uploaded: Hub, source: Path, data_root: Path):
    folder = download(DATASET, remote=REMOTE, progress=False)
    assert folder == data_root / DATASET
    theirs = contents(source / DATASET)
    del theirs["packed/meta.json"]
    assert contents(folder) == theirs
    assert theirs[MANIFEST_NAME].decode().splitlines() == [
        f"{hashlib.sha256(theirs[name]).hexdigest()}  {name}"
        for name in ("data/main_data.hdf5", "data/metadata.json")
    ]
    dataset = minari.load_dataset(DATASET)
    assert dataset[0].actions.shape[1] == 3
    assert list(minari.list_local_datasets()) == [DATASET]
    assert minari.namespace.list_local_namespaces() == ["freeflyer"]
    assert "robot" in minari.namespace.get_namespace_metadata("freeflyer")["description"]
    assert [path.name for path in folder.parent.iterdir() if path.is_dir()] == ["tiny-v0"]


def test_the_namespace_comes_first_and_the_list_last(hub: Hub, source: Path):
    assert upload(DATASET, remote=REMOTE, progress=False) == ADDRESS
    assert hub.messages == [f"Namespace of {DATASET}", f"Upload {DATASET}", f"List {DATASET}"]
    _, namespace, data, listed = hub.repositories["me/freeflyer"]
    assert sorted(namespace) == [".gitattributes", "namespace_metadata.json"]
    assert "datasets" not in json.loads(namespace["namespace_metadata.json"])
    assert sorted(data.keys() - namespace.keys()) == FILES
    assert json.loads(listed["namespace_metadata.json"])["datasets"] == [DATASET]


def test_the_card_is_on_the_page_of_the_repository(hub: Hub, source: Path):
    card = (source / DATASET / "README.md").read_text()
    upload(DATASET, remote=REMOTE, progress=False)
    page = hub.files["README.md"].decode()
    assert page.startswith("---\nlicense: mit\n")
    shown = card.replace("](histograms.png)", "](tiny-v0/histograms.png)")
    shown = shown.replace("](trajectories.png)", "](tiny-v0/trajectories.png)")
    assert shown.split("---\n", 2)[2].strip() in page
    assert shown != card
    edited = page.replace("# freeflyer/tiny-v0", "# old") + "\nBy hand.\n"
    edited += "\n<!-- freeflyer/other-v0 -->\nother\n<!-- end of freeflyer/other-v0 -->\n"
    hub.files["README.md"] = edited.encode()
    upload(DATASET, remote=REMOTE, progress=False)
    page = hub.files["README.md"].decode()
    assert page.count("# freeflyer/tiny-v0") == page.count("license: mit") == 1
    assert "# old" not in page
    assert "By hand." in page
    assert "\nother\n" in page


def test_minari_finds_and_fetches_it(uploaded: Hub, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MINARI_REMOTE", REMOTE)
    assert list(minari.list_remote_datasets()) == [DATASET]
    minari.download_dataset(DATASET)
    assert minari.load_dataset(DATASET).total_episodes > 0


def test_what_others_have_listed_is_kept(hub: Hub, source: Path):
    hub.create({"organization": "me", "name": "freeflyer"})
    theirs = {"description": "theirs", "datasets": ["freeflyer/other-v0"]}
    hub.files["namespace_metadata.json"] = json.dumps(theirs).encode()
    upload(DATASET, remote=REMOTE, progress=False)
    namespace = json.loads(hub.files["namespace_metadata.json"])
    assert namespace == {**theirs, "datasets": ["freeflyer/other-v0", DATASET]}


def test_a_new_version_replaces_the_files(uploaded: Hub, source: Path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(source))
    before = len(uploaded.repositories["me/freeflyer"])
    sent = uploaded.received.copy()
    upload(DATASET, remote=REMOTE, progress=False)
    assert len(uploaded.repositories["me/freeflyer"]) == before
    assert uploaded.received == sent
    (source / DATASET / "data" / "main_data.hdf5").rename(source / DATASET / "data" / "new.hdf5")
    upload(DATASET, remote=REMOTE, progress=False)
    assert DATA not in uploaded.files
    assert "new.hdf5" in uploaded.files[f"tiny-v0/{MANIFEST_NAME}"].decode()
    assert uploaded.received == sent


def test_an_interrupted_upload_sends_only_the_rest(hub: Hub, source: Path):
    data = source / DATASET / "data"
    (data / "more.hdf5").write_bytes(b"more")
    sizes = {digest(path.name, path.read_bytes()): path.stat().st_size for path in data.glob("*5")}
    more = digest("more.hdf5", b"more")
    hub.refuse = lambda request: 400 if request.url.path == f"/store/{more}" else None
    before = contents(source)
    with pytest.raises(SharingError, match=r"was not uploaded: .* Call it again later"):
        upload(DATASET, remote=REMOTE, progress=False)
    assert DATA not in hub.files
    assert more not in hub.received
    hub.refuse = lambda request: 503 if "/commit/" in request.url.path else None
    with pytest.raises(SharingError, match="Call it again later"):
        upload(DATASET, remote=REMOTE, progress=False)
    hub.refuse = lambda request: None
    upload(DATASET, remote=REMOTE, progress=False)
    assert hub.received == sizes
    after = contents(source)
    assert {f"{DATASET}/{MANIFEST_NAME}"} == after.keys() - before.keys()
    assert before.items() <= after.items()


def test_an_interrupted_download_fetches_only_the_rest(uploaded: Hub, data_root: Path):
    size = len(uploaded.files[DATA])
    uploaded.refuse = lambda request: (
        400 if uploaded.served[DATA] > size / 2 and "/resolve/" in request.url.path else None
    )
    for _ in range(2):
        with pytest.raises(SharingError, match="Call it again later: it goes on"):
            download(DATASET, remote=REMOTE, progress=False)
    assert 0 < uploaded.served[DATA] < size
    assert not (data_root / DATASET).exists()
    assert not minari.list_local_datasets()
    uploaded.refuse = lambda request: None
    download(DATASET, remote=REMOTE, progress=False)
    assert uploaded.served[DATA] == size
    assert uploaded.served["tiny-v0/README.md"] == len(uploaded.files["tiny-v0/README.md"])
    assert minari.load_dataset(DATASET)[0].id == 0


def test_an_interrupted_download_of_what_has_changed_starts_again(uploaded: Hub, data_root: Path):
    size = len(uploaded.files[DATA])
    uploaded.refuse = lambda request: 400 if uploaded.served[DATA] > size / 2 else None
    with pytest.raises(SharingError):
        download(DATASET, remote=REMOTE, progress=False)
    uploaded.refuse = lambda request: None
    changed = uploaded.files[DATA][::-1]
    uploaded.files[DATA] = changed
    manifest = uploaded.files[f"tiny-v0/{MANIFEST_NAME}"].decode()
    _, rest = manifest.split(" ", 1)
    manifest = f"{hashlib.sha256(changed).hexdigest()} {rest}"
    uploaded.files[f"tiny-v0/{MANIFEST_NAME}"] = manifest.encode()
    folder = download(DATASET, remote=REMOTE, progress=False)
    assert (folder / "data" / "main_data.hdf5").read_bytes() == changed
    assert (folder / MANIFEST_NAME).read_text() == manifest
    assert not list(data_root.rglob("*.part"))


def test_damage_is_named_and_mended(uploaded: Hub, data_root: Path):
    uploaded.damaged = {DATA}
    with pytest.raises(SharingError, match=r"The checksum of data/main_data\.hdf5 is wrong"):
        download(DATASET, remote=REMOTE, progress=False)
    assert not (data_root / DATASET).exists()
    uploaded.damaged = set()
    uploaded.served.clear()
    download(DATASET, remote=REMOTE, progress=False)
    assert uploaded.served[DATA] == len(uploaded.files[DATA])
    assert uploaded.served["tiny-v0/README.md"] == 0


def test_a_server_without_ranges(uploaded: Hub, monkeypatch: pytest.MonkeyPatch):
    resolve = uploaded.resolve

    def whole(request: http.Request, *where: str) -> http.Response:
        request.headers.pop("range", None)
        return resolve(request, *where)

    monkeypatch.setattr(uploaded, "resolve", whole)
    with pytest.raises(SharingError, match=r"sent \d+ bytes of main_data\.hdf5, not 20000"):
        download(DATASET, remote=REMOTE, progress=False)


def test_without_a_manifest_the_checksum_is_the_hubs(uploaded: Hub):
    del uploaded.files[f"tiny-v0/{MANIFEST_NAME}"]
    uploaded.damaged = {DATA}
    with pytest.raises(SharingError, match="checksum"):
        download(DATASET, remote=REMOTE, progress=False)
    uploaded.damaged = set()
    assert download(DATASET, remote=REMOTE, progress=False).is_dir()


def test_a_local_dataset_is_kept_unless_forced(
    uploaded: Hub, source: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(source))
    marker = source / DATASET / "packed" / "meta.json"
    with pytest.raises(SharingError, match=r"already in .* force=True"):
        download(DATASET, remote=REMOTE, progress=False)
    uploaded.damaged = {DATA}
    with pytest.raises(SharingError, match="checksum"):
        download(DATASET, remote=REMOTE, force=True, progress=False)
    assert marker.is_file()
    uploaded.damaged = set()
    download(DATASET, remote=REMOTE, force=True, progress=False)
    assert not marker.exists()
    assert minari.load_dataset(DATASET).total_episodes > 0
    assert [path.name for path in marker.parents[2].iterdir() if path.is_dir()] == ["tiny-v0"]


def test_a_failed_replacement_brings_the_old_one_back(tmp_path: Path):
    (tmp_path / "old").mkdir()
    with pytest.raises(OSError, match="absent"):
        sharing._install(tmp_path / "absent", tmp_path / "old")
    assert (tmp_path / "old").is_dir()


def test_an_unfinished_upload_is_refused(uploaded: Hub):
    del uploaded.files[DATA]
    with pytest.raises(SharingError, match=r"unfinished: data/main_data\.hdf5 is missing"):
        download(DATASET, remote=REMOTE, progress=False)


def test_a_newer_format_is_refused_before_the_data(uploaded: Hub, data_root: Path):
    metadata = json.loads(uploaded.files["tiny-v0/data/metadata.json"])
    text = json.dumps({**metadata, "minari_version": "99.0"})
    uploaded.files["tiny-v0/data/metadata.json"] = text.encode()
    with pytest.raises(SharingError, match=r"of Minari 99\.0, .* pip install --upgrade minari"):
        download(DATASET, remote=REMOTE, progress=False)
    assert uploaded.served[DATA] == 0
    assert not list(data_root.iterdir())


def test_too_little_space(uploaded: Hub, monkeypatch: pytest.MonkeyPatch):
    usage = dataclasses.make_dataclass("Usage", ["free"])(1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(SharingError, match=r"GB are free\. Make room"):
        download(DATASET, remote=REMOTE, progress=False)


@pytest.mark.parametrize("share", [upload, download])
def test_offline(hub: Hub, source: Path, share, monkeypatch: pytest.MonkeyPatch):
    dataset = DATASET if share is upload else "freeflyer/other-v0"
    before = contents(source)

    def unplugged(request: http.Request) -> None:
        raise http.ConnectError("Name or service not known")

    hub.refuse = unplugged
    with pytest.raises(SharingError, match=r"cannot be reached \(Name or .* goes on where") as info:
        share(dataset, remote=REMOTE, progress=False)
    assert "\n" not in str(info.value)
    assert before.items() <= contents(source).items()

    def offline(request: http.Request) -> None:
        raise http_of_hub.OfflineModeIsEnabled("offline")

    hub.refuse = offline
    with pytest.raises(SharingError, match="HF_HUB_OFFLINE is set"):
        share(dataset, remote=REMOTE, progress=False)


def test_tokens(uploaded: Hub, source: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HF_TOKEN", "bad")
    with pytest.raises(SharingError, match="does not accept the token"):
        download(DATASET, remote=REMOTE, progress=False)
    monkeypatch.setenv("HF_TOKEN", "good")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(source))
    with pytest.raises(SharingError, match=r"does not accept the token.*hf auth login"):
        upload(DATASET, remote=REMOTE, token="bad", progress=False)
    with pytest.raises(SharingError, match=r"does not permit .*remote='hf://OWNER'"):
        upload(DATASET, progress=False)


def test_two_uploads_at_once(hub: Hub, source: Path):
    def interfere(request: http.Request) -> None:
        if "/commit/" in request.url.path and b"List " in request.read():
            commits = hub.repositories["me/freeflyer"]
            commits.append(dict(commits[-1]))

    hub.refuse = interfere
    with pytest.raises(SharingError, match="changed in the meantime"):
        upload(DATASET, remote=REMOTE, progress=False)


def test_unknown_datasets(uploaded: Hub, recipe: Recipe, data_root: Path):
    with pytest.raises(SharingError, match=f"no dataset 'freeflyer/no-v0' .* {recipe.id}"):
        download("freeflyer/no-v0", remote=REMOTE, progress=False)
    with pytest.raises(SharingError, match="no such repository"):
        download("nobody/no-v0", remote=REMOTE, progress=False)
    with pytest.raises(SharingError, match=r"Make it with freeflyer_datasets\.build"):
        upload("freeflyer/no-v0", remote=REMOTE, progress=False)
    assert not list(data_root.iterdir())


@pytest.mark.parametrize("dataset_id", ["", "freeflyer/tiny", "../tiny-v0", "hf://me/tiny-v0"])
def test_bad_ids(dataset_id: str):
    with pytest.raises(SharingError, match="give one like 'freeflyer/scene-1-v0'"):
        download(dataset_id, remote=REMOTE, progress=False)


@pytest.mark.parametrize("remote", ["me", "gcp://minari", "hf://me/freeflyer", "hf://"])
def test_bad_remotes(remote: str):
    with pytest.raises(SharingError, match="give remote='hf://OWNER'"):
        download(DATASET, remote=remote, progress=False)


def test_a_dataset_without_a_namespace(hub: Hub, source: Path, data_root: Path, monkeypatch):
    metadata = source / DATASET / "data" / "metadata.json"
    text = metadata.read_text().replace(DATASET, "tiny-v0")
    metadata.write_text(text)
    with pytest.raises(SharingError, match="holds the dataset 'tiny-v0'"):
        upload(DATASET, remote=REMOTE, progress=False)
    (source / DATASET).rename(source / "tiny-v0")
    upload("tiny-v0", remote=REMOTE, progress=False)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(data_root))
    assert contents(download("tiny-v0", remote=REMOTE, progress=False)).keys() == {
        *("README.md", MANIFEST_NAME, "data/main_data.hdf5", "data/metadata.json"),
        *("histograms.png", "trajectories.png"),
    }


@pytest.mark.parametrize("module", ["huggingface_hub", "minari.dataset.minari_dataset"])
def test_missing_packages(module: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SharingError, match=rf"{module.split('.')[0]} is missing\. pip install"):
        upload(DATASET, remote=REMOTE, progress=False)


def test_it_is_imported_without_the_packages():
    code = (
        "import sys, freeflyer_datasets.sharing; "
        "sys.exit(bool({'minari', 'huggingface_hub', 'h5py'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
