"""The `ssmail` command line: it parses, calls ssmail, and prints; it computes nothing."""
