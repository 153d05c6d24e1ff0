"""Compiled kernels: the one policy of compiling, the cache, and the digest that both are known by."""
