# SPDX-License-Identifier: Apache-2.0
"""Many runs, one table: recordings x settings x seeds."""
