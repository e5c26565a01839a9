"""report.html: the report as a page, rendered from report.json alone."""

from __future__ import annotations

from html import escape
from typing import Any


def render_html(report: dict[str, Any]) -> str:
    """A page of the report."""
    return f"<!doctype html><title>{escape(report['project'])}</title><pre>{escape(str(report['check_points']))}</pre>"
