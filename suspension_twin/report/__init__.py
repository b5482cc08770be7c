# SPDX-License-Identifier: Apache-2.0
"""Plots and self-contained HTML pages."""

from __future__ import annotations

from suspension_twin.report.page import Card, Cell, Html, Lead, Page, Row, Section, Table

__all__ = ["Card", "Cell", "Html", "Lead", "Page", "Row", "Section", "Table"]
