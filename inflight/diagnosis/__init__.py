"""From a residual to the missing effect.

Takes the Gram blocks of a pass over the archive (`inflight.tasks.analysis.gram_pass` makes them), the
library of candidates and the coarse series; makes a `Diagnosis`: effects with values and errors, rivals,
what remains, one sentence. All of it is algebra on the Gram blocks; no sample is read again. Open
``verdict.py`` first: `run_search` is the whole walk.

The walk, step by step, with the file of each:

1. **Residual** (``inflight/model/rows.py``, ``inflight/design/columns.py``, ``series.py``). Native samples
   become rows on the library's bins, spikes and bursts left out; means of them are the coarse series.
2. **Candidates** (``candidates.py``, ``time_changes.py``). Every effect with every channel, lag and width;
   shifted channels as placebos; steps, episodes and drifts, which are columns times a function of the
   block.
3. **State** (``search.py``). `Search` is one frozen record: the options, what was taken, the ledger. Every
   step below is a function from a state to the next one. The Gram blocks, in three forms (raw, within-day,
   prewhitened) with the calibration marginalised, are shared by all states: `SharedGrams`.
4. **Ranking** (``scoring.py``). Held-out gain and its t, score statistics, sign-flip test over all
   candidates and forms together, best placebo: one `ScoreTable` a round.
5. **Stepwise selection** (``stepwise.py``). The best option that passes `Rules` is added, effects it made
   superfluous are dropped; what lies in few blocks gets the few-block test. A change in time is judged with
   calibration intervals whose edges keep away from it (``search.py``, `intervals_around`).
6. **Refinement** (``refine.py``). Before the next round what was taken gets its best form: lag, width,
   change time.
   **Other forms** (``forms.py``). When something is left, or was taken, every other combination of what a
   channel acts on and how it is followed is tried, and products of two channels last.
7. **Rivals** (``stepwise.py``). Whatever does as well in an effect's place is its rival; what does better
   is exchanged for it.
   **Other choices** (``choices.py``, ``wide_bins.py``). The nearest of them once more, with other blocks,
   folds and cadences. **Noise of what is followed** (``attenuation.py``) is taken off values.
8. **Verdict** (``verdict.py``, ``residual.py``, ``signature.py``, ``result.py``). Values with errors, sizes
   of the residual before and after, what remains (a line, a band, structure), and the sentence.

Not in the walk: ``additions.py`` and ``requests.py`` put an effect into the model and fit everything
jointly, for ``inflight add``, ``drop`` and ``undo``; ``figure_data.py`` makes the numbers that the figures of
a finished search show.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
