"""The claims of the paper, C1 to C8: what is measured of each run, which test decides, and what the verdict is.

One module for each claim: its sentence, the number that is taken of a run (pure functions of curves and arrays), and
`decide`, from every seed's numbers to the parts of a verdict. Nothing here reads a store; `ssmail.evidence` does.
docs/claims.md is the same in words, written before any of it was applied to a result.
"""
