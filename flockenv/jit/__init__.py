"""From Python to machine code: marks, sections, the compiler's pipeline, what is kept on disk, threads, memory."""
