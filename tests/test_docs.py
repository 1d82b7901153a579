"""The Python snippets of the README and the guides run as written, one after the other."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
#: Those that teach; the other one has commands and tables.
GUIDES = [page for page in PAGES if page.name != "reproduction.md"]


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.name)
def test_snippets_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    text = page.read_text(encoding="utf-8")
    snippets = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(snippets) >= 4
    namespace: dict[str, object] = {"__name__": "guide"}
    for number, snippet in enumerate(snippets):
        exec(compile(snippet, f"{page.name}, snippet {number}", "exec"), namespace)


def test_tables_are_those_of_the_evaluations():
    spec = importlib.util.spec_from_file_location("tables", ROOT / "docs" / "tables.py")
    assert spec
    assert spec.loader
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
    shown = 0
    for page in tables.PAGES:
        text = page.read_text(encoding="utf-8")
        shown += text.count("<!-- table:")
        assert tables.filled(text) == text, f"{page}: run python docs/tables.py"
    assert shown
    with pytest.raises(ValueError, match="no method 'RELL'"):
        tables.filled(re.sub(r"\| REL;", "| RELL;", (ROOT / "README.md").read_text()))


def test_links_point_to_files():
    for page in (*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "datasets" / "README.md"):
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if not target.startswith(("http", "mailto")):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"
