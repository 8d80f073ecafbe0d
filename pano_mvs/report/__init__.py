"""The report of a run: one self-contained HTML page for people."""

from pano_mvs.report.page import write_report

__all__ = ["write_report"]
