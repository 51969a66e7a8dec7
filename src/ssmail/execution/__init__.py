"""Where runs are computed. `ssmail.execution.local` runs cells in processes of this machine."""
