# SPDX-License-Identifier: Apache-2.0
"""Speed of the signal path, measured beside peers in the same process; nothing here runs on the road."""
