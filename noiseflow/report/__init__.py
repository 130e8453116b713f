"""Components of the self-contained HTML report: page, figures, interactive images and provenance.

How a composition works: each method of `Report` adds a part, rendered by its macro in ``assets/parts.html``, which escapes all
text; `save` places the parts, styles and scripts in ``assets/page.html``. Stacks become `Sprites`, which the scripts unpack.
"""

from noiseflow.report.charts import COLOURS as COLOURS
from noiseflow.report.charts import STYLES as STYLES
from noiseflow.report.charts import Chart as Chart
from noiseflow.report.charts import grey_range as grey_range
from noiseflow.report.charts import new_figure as new_figure
from noiseflow.report.charts import residual_histogram as residual_histogram
from noiseflow.report.charts import show_image as show_image
from noiseflow.report.page import Report as Report
from noiseflow.report.page import add_verdict as add_verdict
from noiseflow.report.page import effects_chart as effects_chart
from noiseflow.report.page import provenance as provenance
from noiseflow.report.sprites import Sprites as Sprites
from noiseflow.report.sprites import make_sprites as make_sprites
