"""A printed page that states a calibration and its uncertainty after the GUM."""

from __future__ import annotations

from flangeye.report.certificate.budget import Budget, Conditions, budget_of, use_budget_of
from flangeye.report.certificate.page import print_pdf, write_certificate

__all__ = [
    "Budget",
    "Conditions",
    "budget_of",
    "print_pdf",
    "use_budget_of",
    "write_certificate",
]
