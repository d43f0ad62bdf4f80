"""The import-linter contract ``faces``: a folder's modules are its own, others import from the folder."""

from __future__ import annotations

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output


class FacesContract(Contract):
    """Every import from another folder goes through that folder's ``__init__``.

    A folder's own modules, and those of folders inside it, import one another as they like. Modules that
    stand directly in the root package are public.
    """

    root = fields.StringField()

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Return the imports that go past a face."""
        past = []
        own = {module for module in graph.modules if module.startswith(f"{self.root}.")}
        folders = {module.rpartition(".")[0] for module in own}
        for importer in sorted(own):
            for imported in sorted(graph.find_modules_directly_imported_by(importer) & (own - folders)):
                folder = imported.rpartition(".")[0]
                if folder == self.root:
                    continue
                if importer != folder and not importer.startswith(f"{folder}."):
                    past.append((importer, imported))
        return ContractCheck(kept=not past, metadata={"past": past})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Say which imports go past a face, and what to write instead."""
        for importer, imported in check.metadata["past"]:
            folder = imported.rpartition(".")[0]
            output.print_error(f"{importer} imports {imported}: import from {folder}, whose face names it")
