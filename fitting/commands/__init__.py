"""The commands of `hdjax`.

`fit`, `motion`, `response` and `studies` define arguments, without slow imports. Each calls a module `run_*` for the
work, after checking the arguments.
"""
