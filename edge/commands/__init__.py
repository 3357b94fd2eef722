# SPDX-License-Identifier: Apache-2.0
"""One module for every verb of the command line: ``add_arguments(parser)`` and ``run(args) -> exit code``."""
