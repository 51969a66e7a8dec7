"""`python -m ssmail_cli` is `ssmail`."""

from ssmail_cli.main import main

main()
