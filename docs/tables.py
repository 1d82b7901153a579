"""Writes the tables of the pages from the evaluations in ``docs/results``.

``python docs/tables.py`` does it, ``python docs/tables.py out/report.json`` puts a new evaluation
there first; a test sees to it that it was done.
A page says where a table comes from in a comment, and this script fills in what is behind it::

    <!-- table: docs/results/held_out.json | all | REL; ART; ART, best of 4 -->
    ...
    <!-- end of table -->

that is a report of ``freeflyer evaluate``, a group of its problems, and the methods to show. With
``cells`` as the group, numbers of obstacles and final times are set against one another. Of the
JSON of a benchmark it is the way to a list of rows, and the columns to show::

    <!-- table: docs/results/flights.json | tables/held-out, 40 s/flights | tracker; RMS, mm -->
"""

from __future__ import annotations

import argparse
import json
import math
import re
from pathlib import Path
from typing import Any

from art_policy.evaluation import markdown_table

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "art_policy" / "pretrained").glob("*/README.md")),
]
_TABLE = re.compile(r"(<!-- table: (.*?) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def filled(page: str) -> str:
    """The text of a page with its tables made anew.

    Raises:
        ValueError: If a report has no such group or method.
    """
    return _TABLE.sub(lambda match: match[1] + _table(match[2]) + match[3], page)


def _table(source: str) -> str:
    path, group, methods = (part.strip() for part in source.split("|"))
    data = json.loads((ROOT / path).read_text(encoding="utf-8"))
    if "groups" not in data:
        for key in group.split("/"):
            data = data[key]
        return _rows(data, [name.strip() for name in methods.split(";")])
    groups = data["groups"]
    if group == "cells":
        return _grid(groups, *(name.strip() for name in methods.split(";")))
    if group not in groups:
        raise ValueError(f"{path} has no group {group!r}, only {', '.join(groups)}.")
    rows = {}
    for method in (name.strip() for name in methods.split(";")):
        if method not in groups[group]:
            raise ValueError(f"{path} has no method {method!r}, only {'; '.join(groups[group])}.")
        row = groups[group][method]
        rows[method] = {key: math.nan if row[key] is None else row[key] for key in row}
    return f"\n{markdown_table(rows)}\n\n"


def _rows(rows: list[dict[str, Any]], columns: list[str]) -> str:
    """Rows of a benchmark: numbers to three digits."""
    if unknown := set(columns) - set(rows[0]):
        raise ValueError(f"There is no column {sorted(unknown)}, only {'; '.join(rows[0])}.")

    def text(value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"

    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    lines += ["| " + " | ".join(text(row[name]) for name in columns) + " |" for row in rows]
    return "\n" + "\n".join(lines) + "\n\n"


def _grid(groups: dict[str, Any], base: str, method: str) -> str:
    """Infeasible rates of two methods and the second one's improvement, a row for each number."""
    cells = {}
    for name, group in groups.items():
        if match := re.fullmatch(r"(\d+) obstacles, T_f = (.*) s", name):
            one, other = group[base], group[method]
            text = f"{one['infeasible_rate']:.1%} → {other['infeasible_rate']:.1%}"
            if other["suboptimality_improvement"] is not None:
                text += f"; {other['suboptimality_improvement']:+.1%}"
            cells[int(match[1]), float(match[2])] = text
    counts, times = (sorted({cell[axis] for cell in cells}) for axis in range(2))
    lines = ["| obstacles | " + " | ".join(f"{time:g} s" for time in times) + " |"]
    lines.append("|---" * (1 + len(times)) + "|")
    for count in counts:
        row = (cells.get((count, time), "") for time in times)
        lines.append(f"| {count} | " + " | ".join(row) + " |")
    return "\n" + "\n".join(lines) + "\n\n"


def main() -> None:
    """Adds reports if there are any, and fills in the tables of all pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    text = "report of freeflyer evaluate to put into docs/results, without its single problems"
    parser.add_argument("reports", nargs="*", type=Path, help=text)
    for path in parser.parse_args().reports:
        data = json.loads(path.read_text(encoding="utf-8"))
        data.pop("records", None)
        kept = RESULTS / path.name
        kept.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if (new := filled(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(f"wrote {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
