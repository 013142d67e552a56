# SPDX-License-Identifier: Apache-2.0
"""Finished maps trained further: a run's, or a grid store's cell by cell."""
