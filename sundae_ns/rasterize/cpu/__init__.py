"""The backend for CPUs: loops that numba compiles."""
