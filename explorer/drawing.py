"""JavaScript that runs once in a page: what Bokeh 3.9 does more often than a page needs."""

from __future__ import annotations

#: Figures listen to the zoom of the window for as long as the page is open, so that none that was replaced
#: could go (bokeh/bokeh, issue 15290). Here those that are shown are told.
_ZOOM = """
if (window.visualViewport) {
  const listen = visualViewport.addEventListener.bind(visualViewport);
  visualViewport.addEventListener = (kind, ...rest) => { if (kind !== "resize") listen(kind, ...rest) };
  listen("resize", () => {
    for (const figure of Bokeh.index.query((one) => one.canvas_view && one.request_repaint))
      if (figure.canvas_view.resize()) figure.request_repaint();
  });
}
"""

#: For each property of all they draw, and whenever they draw it, figures ask the browser for a style of the
#: page (bokeh/bokeh, issue 15286), which no page here has: a third of a page's time.
_STYLES = """
Bokeh.require("core/visuals/visual").VisualProperties.prototype._get_css_value = () => "";
"""

#: Whatever changes on a page, all of it is laid out and drawn again. Here that is done once for all that has
#: changed when the browser is about to show it: a change of the model is a dozen changes. A page that is not
#: seen shows nothing; there a timer does it.
_LAYOUT = """
const {LayoutDOMView} = Bokeh.require("models/layouts/layout_dom");
const view = LayoutDOMView.prototype, {invalidate_layout, compute_layout} = view;
view.invalidate_layout = function () {
  if (this.parent instanceof LayoutDOMView) { this.parent.invalidate_layout(); return }
  if (this.inflightDue) return;
  this.inflightDue = true;
  const lay_out = () => {
    cancelAnimationFrame(frame); clearTimeout(timer);
    this.inflightDue = false;
    if (!this.is_destroyed) invalidate_layout.call(this);
  };
  const frame = requestAnimationFrame(lay_out), timer = setTimeout(lay_out, 200);
};
view.compute_layout = function () { if (!this.inflightDue) compute_layout.call(this) };
"""

#: Other versions of Bokeh are left as they are.
DRAWING = (
    'if (!window.inflightDrawing && Bokeh.version.startsWith("3.9.")) { window.inflightDrawing = true;'
    + _ZOOM
    + _STYLES
    + _LAYOUT
    + "}"
)
