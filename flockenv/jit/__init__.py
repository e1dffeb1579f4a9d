"""From Python to machine code: decorators, sections, compiler pipeline, disk cache, thread pool, memory."""
