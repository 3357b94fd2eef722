# SPDX-License-Identifier: Apache-2.0
"""``python -m edge`` is ``rfconstruct``."""

from edge.cli import main

raise SystemExit(main())
