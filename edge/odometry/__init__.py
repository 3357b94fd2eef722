# SPDX-License-Identifier: Apache-2.0
"""Where poses come from."""
