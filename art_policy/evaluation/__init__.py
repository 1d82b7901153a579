"""The paper's evaluation: warm starts compared on the same problems, with the same SCP.

Data flows from :func:`evaluation_problems` through :func:`evaluate`, which runs every method on
every problem, to :func:`report`, its table and its figures.
"""

from art_policy.evaluation.protocol import (
    Outcome,
    ProblemRecord,
    evaluate_problem,
    evaluation_problems,
)
from art_policy.evaluation.running import evaluate
from art_policy.evaluation.statistics import (
    C_REL_THRESHOLDS,
    PAPER,
    finite,
    markdown_table,
    report,
    save_report,
    summarise,
)

__all__ = [
    "C_REL_THRESHOLDS",
    "PAPER",
    "Outcome",
    "ProblemRecord",
    "evaluate",
    "evaluate_problem",
    "evaluation_problems",
    "finite",
    "markdown_table",
    "report",
    "save_report",
    "summarise",
]
