"""Components of the self-contained HTML report: page, figures, interactive images and provenance.

How a composition works: each method of `Report` adds a part, rendered by its macro in ``assets/parts.html``, which escapes all
text; `save` places the parts, styles and scripts in ``assets/page.html``. Stacks become `Sprites`, which the scripts unpack.
"""

from noiseflow.report.charts import COLOURS, Chart, new_figure, show_image
from noiseflow.report.page import Report, add_verdict, effects_chart, provenance
from noiseflow.report.sprites import Sprites, make_sprites

__all__ = [
    "COLOURS",
    "Chart",
    "Report",
    "Sprites",
    "add_verdict",
    "effects_chart",
    "make_sprites",
    "new_figure",
    "provenance",
    "show_image",
]
