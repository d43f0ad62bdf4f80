"""Two sensors on one boom: the spacecraft's field found in their difference, and taken off.

In go readings of an inboard and an outboard sensor (`Readings`), with the positions of sensors and units
where they are known (`Body`); out come a correction of the outboard reading with its error (`Correction`),
the decision whether it is applied (`HeldOutDecision`), a table of the spacecraft's states (`Training`) and
the level-2 product. The ambient field is the same at both sensors, so that their difference
``d = B_in - B_out`` is the spacecraft's field alone, with both sensors' offsets and noise. Delva et al.
(Venus Express) recognise the spacecraft's states in it; Ness et al. (1971) scale it to the outboard sensor.

Words, each with one meaning: a *unit* is what is switched on and off; a *jump* is a change point of the
difference; a *segment* is a stretch between two jumps; a *state* is the combination of units that are on, a
point in the space of the difference to which segments return; a *switching* is a passage from one state to
another; a *window* is the days from which one table is learnt.

Open first: `readings.py`, then `candidates.py` (which corrections there are) and `held_out.py` (which one is
applied); `segments.py`, `states.py`, `training.py`, `assignment.py` are the method by states, `geometry.py`,
`mixing.py`, `gradiometer.py` the method by one matrix.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
