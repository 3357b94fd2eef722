# SPDX-License-Identifier: Apache-2.0
"""The networks that are compared; ``registry`` builds them by name."""
