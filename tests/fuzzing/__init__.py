"""Damaged files for every reader, in a child process with limits on memory and time.

=============  ==========================================================================
`readers`      readers of files that come from outside, with small sound files to damage
`damage`       to bytes; `shells`: within archives, pictures, texts that stay sound
`crafted`      files made to harm
`cases`        case k of a reader
`watch`        what a load opens for writing, starts or unpickles
`attempts`     a load within limits on memory and time
`child`        loads one case after another; `parent`: asks, and starts it again
=============  ==========================================================================

The child answers for each file what came out; where it dies or says nothing for long, the parent
names the file it was at and starts another one.

A report names a case by its reader and its number. In the folder of the tests ``python -m fuzzing
READER K [FOLDER]`` makes it again, and says what comes out; ``python -m fuzzing --survey COUNT
[WORD ...]`` tries so many cases (0: the crafted ones) of the readers with a word in their names,
from ``FUZZ_FIRST`` on.
"""
