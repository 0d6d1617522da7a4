"""Comparison of planners on suites of problems through OMPL's Benchmark, and its reports."""

from __future__ import annotations

from apex_ompl.evaluation.driver import Workers, bench
from apex_ompl.evaluation.page import markdown, report
from apex_ompl.evaluation.results import Results, write_database, write_logs
from apex_ompl.evaluation.rows import Row

__all__ = ["Results", "Row", "Workers", "bench", "markdown", "report", "write_database", "write_logs"]
