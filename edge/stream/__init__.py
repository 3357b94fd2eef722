# SPDX-License-Identifier: Apache-2.0
"""Wire format, publisher and client."""
