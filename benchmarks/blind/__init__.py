# SPDX-License-Identifier: Apache-2.0
"""Cases whose effect is withheld: two realities, a plan of cases, sealed labels, and the score.

Nothing here uses the package's models or effects to make a case: the vehicle's motion comes from
``newton`` or from ``multibody``, the phone from ``phone``. Only the file formats are shared.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
for _folder in (ROOT / "bags", ROOT):
    if str(_folder) not in sys.path:
        sys.path.insert(0, str(_folder))
