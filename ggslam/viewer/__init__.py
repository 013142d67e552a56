# SPDX-License-Identifier: Apache-2.0
"""Looking at a map in a browser: one page, served by Python's own web server or as a file that needs neither server nor
network."""
