"""One self-contained HTML page about a run, made from its log alone."""

from flangeye.workflow.report.page import write_report

__all__ = ["write_report"]
