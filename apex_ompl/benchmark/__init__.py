"""Comparison of planners on suites of problems through OMPL's Benchmark, and its reports."""

from __future__ import annotations

from apex_ompl.benchmark.driver import bench
from apex_ompl.benchmark.log import write_database, write_logs
from apex_ompl.benchmark.page import markdown, report
from apex_ompl.benchmark.results import Results
from apex_ompl.benchmark.rows import Row
from apex_ompl.benchmark.workers import Workers

__all__ = ["Results", "Row", "Workers", "bench", "markdown", "report", "write_database", "write_logs"]
