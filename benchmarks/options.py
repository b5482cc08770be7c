# SPDX-License-Identifier: Apache-2.0
"""The option ``--smoke``, which every benchmark has."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

__all__ = ["parse_options"]


def parse_options(parser: ArgumentParser, **reduced: Any) -> Namespace:
    """Options of the command line; with ``--smoke`` the defaults are those of ``reduced``, so that the whole program
    runs in seconds to a minute and its figures mean nothing."""
    parser.add_argument("--smoke", action="store_true", help="at a reduced size: its figures mean nothing")
    if parser.parse_known_args()[0].smoke:
        parser.set_defaults(**reduced)
    return parser.parse_args()
