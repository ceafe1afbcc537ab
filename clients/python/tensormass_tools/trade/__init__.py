"""`tensormass trade`: what each choice that a scene leaves open costs in time and buys in accuracy.

arguments      the command's options
knobs          what a scene lets one choose, and the scene file of a choice
scene_edits    edits of a scene file's fields
small_strain   which laws are equal for small strains
script         the test run that every choice is put through
recording      what is recorded of it
recorder       puts scenes through the script and times them
energy         the energy of a step, from the GPU's counter
interpolation  a mesh's displacements at the points of another mesh
measures       how far one recording is from another
reference      the scene refined until it no longer moves
sweep          which choices to measure, and which of them are worth having
store          one line for each measurement, so that a run can go on where it was stopped
outcome        what a run found
session        all measurements of a run
report, html   table and HTML page
files          the files that a run writes
command        all of it together
"""
