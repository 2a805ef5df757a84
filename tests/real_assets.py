"""Where real meshes may lie: a checkout can do without them, and tests that want them then say so and are skipped."""

from __future__ import annotations

import os
from pathlib import Path

REAL_ASSETS = Path(os.environ.get("CAVIN_ASSETS") or Path(__file__).resolve().parents[2] / "shared" / "assets")
