# SPDX-License-Identifier: Apache-2.0
"""Where radar frames come from."""
