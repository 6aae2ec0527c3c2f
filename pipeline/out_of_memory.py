"""Memory that was refused, by whichever library asked for it."""

_WORDS = ("can't allocate memory", "std::bad_alloc", "out of memory", "CUBLAS_STATUS_ALLOC_FAILED")
"""How torch says it on processors (a bare RuntimeError) and on accelerators."""

ADVICE = "out of memory; use fewer --workers, a part of the log (--start, --end), or a larger infer.grid.stride_steps"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether `error` says that memory was refused; of numpy and pyarrow it is a `MemoryError`, of torch it need not be."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(words in str(error) for words in _WORDS))
