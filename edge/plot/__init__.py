# SPDX-License-Identifier: Apache-2.0
"""Pictures of what the pipeline sees; needs the extra "plot" (matplotlib)."""
