"""The report: HTML pages and a PDF from executed notebooks."""

from slamlib.report.build import build_report
from slamlib.report.notebooks import NotebookError

__all__ = ["NotebookError", "build_report"]
