"""The report of a reproduction: verdicts, figures and the runs behind them, as one HTML page and as Markdown.

`drawing` saves a figure and keeps what the report shows of it, `contents` gathers what a report holds, `pages` writes
it. Importing this package imports neither Jinja2 nor matplotlib.
"""
