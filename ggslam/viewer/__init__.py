# SPDX-License-Identifier: Apache-2.0
"""Looking at a map in a browser: a page served by viser (optional extra `viewer`), and a static page that needs neither
server nor network."""
