# SPDX-License-Identifier: Apache-2.0
"""A large world of boxes for a laser scanner, for tests and benchmarks of localisation and of stored maps."""
