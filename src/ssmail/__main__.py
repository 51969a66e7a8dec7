"""`python -m ssmail` is `ssmail`."""

from ssmail_cli.main import main

main()
