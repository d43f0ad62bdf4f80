"""The web page of a workspace: compare, diagnose the missing effect, revise the model, show tables.

In goes an opened workspace; out comes a local web server (`Server`) whose page calls the functions behind
the verbs ``compare``, ``diagnose``, ``add``, ``drop``, ``undo`` and ``reprocess``. Open ``session.py`` first:
`ExplorerSession` is everything the page can do, without widgets. ``page.py`` is the layout, ``view_state.py``
what stands in its address; its tabs are ``loop_view.py`` (what it says: ``loop_state.py``), ``views.py``
(compare, tables) and ``diagnosis_view.py``; ``job_pane.py`` shows progress and result of work in
``background.py``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
