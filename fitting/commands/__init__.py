"""The commands of `hdjax`.

`fit`, `motion`, `response` and `studies` state what a user may type, and import nothing that takes long. Each calls a
module `run_*`, which does the work, once the arguments are known to be good.
"""
