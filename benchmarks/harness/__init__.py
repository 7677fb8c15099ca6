"""What the scripts of ``benchmarks/`` share: comparisons of methods that resume, and the ends of a command."""
