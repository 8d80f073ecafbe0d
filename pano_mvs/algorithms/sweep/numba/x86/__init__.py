"""Vector instructions of x86, written as LLVM; every function has a portable counterpart one folder up."""
