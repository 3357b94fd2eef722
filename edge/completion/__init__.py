# SPDX-License-Identifier: Apache-2.0
"""The shape completion model at run time."""
