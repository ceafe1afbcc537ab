"""`tensormass trade`: what each choice that a scene leaves open costs in time and buys in accuracy.

knobs          what a scene lets one choose, and the scene file of a choice
script         the test run that every choice is put through, and what is recorded of it
interpolation  a mesh's displacements at the points of another mesh
measures       how far one recording is from another
reference      the scene refined until it no longer moves
sweep          which choices to measure, and which of them are worth having
store          one line for each measurement, so that a run can go on where it was stopped
report         table and HTML page
command        all of it together
"""
