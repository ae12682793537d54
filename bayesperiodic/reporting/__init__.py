"""The report: one self-contained HTML page about a fit, for people who do not run Python."""
