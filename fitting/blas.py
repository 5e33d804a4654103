"""Threads of the linear algebra."""

from threadpoolctl import threadpool_limits

one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorator of functions whose matrices are small: threads of BLAS would wait for each other longer than they work."""
