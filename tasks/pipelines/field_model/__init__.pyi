from .pipeline import FieldModelPipeline

__all__ = ["FieldModelPipeline"]
