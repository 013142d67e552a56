# SPDX-License-Identifier: Apache-2.0
"""Calibrations that other programs write, translated into the entries of a camera.yaml; see `reading.read_entries`."""
