"""Native code needs a C++ compiler: tests that make some say so where there is none, and are skipped."""

from __future__ import annotations

import os
import shutil

import pytest

needs_a_compiler = pytest.mark.skipif(
    shutil.which(os.environ.get("CXX", "g++")) is None, reason="needs a C++ compiler: g++, or one that CXX names"
)
