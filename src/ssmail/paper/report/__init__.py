"""The report on a reproduction: verdicts, figures and the runs behind them, as one HTML page and as Markdown.

`drawing` draws and saves a figure for the report, `contents` gathers the rest, `pages` writes the files. Importing this
package imports neither Jinja2 nor matplotlib.
"""
