"""The golden record: what the software gives for a fixed set of small missions, kept and compared.

``python -m benchmarks.golden make DIR`` runs the cases of `cases` through the command line and keeps what
came out in a folder; ``python -m benchmarks.golden compare A B`` tells what differs between two such folders.
Nothing of the software is imported but the catalog, by `export` in a process of its own: the same files
record any checkout, older or newer. Open `cases` to see what is run, `compare` for the tolerances, `reading`
for what is left out.
"""
