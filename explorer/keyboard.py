"""Figures, tables and tabs of the page by the keyboard: what the mouse does, with a ring around what has it.

Browsers reach what is there with Tab by themselves. In a figure the arrows move a cross (with Shift faster),
which reads it as the mouse does; Enter clicks there; Space begins a brush and ends it. In a table the arrows
choose a row, and Enter selects it. On a tab the arrows go to the next one, and Enter opens it.
"""

#: Run once in a page. Elements of widgets live in shadow roots, which focus events do not leave.
KEYS = """
if (!window.inflightKeys) {
  window.inflightKeys = true;
  const RING = "#d55e00", STEP = 1 / 40, FAST = 1 / 8;
  const ARROWS = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};
  const places = new WeakMap(), rows = new WeakMap();
  let ringed = null, cross = null;
  const focused = () => {
    let one = document.activeElement;
    while (one?.shadowRoot?.activeElement) one = one.shadowRoot.activeElement;
    return one;
  };
  const ring = (one) => {
    if (ringed) ringed.style.outline = "";
    ringed = one && one !== document.body ? one : null;
    if (ringed) { ringed.style.outline = `3px solid ${RING}`; ringed.style.outlineOffset = "-2px" }
  };
  const hide = () => { cross?.remove(); cross = null };
  const show = (x, y) => {
    if (!cross) {
      cross = document.createElement("div");
      cross.style.cssText = "position:fixed;width:17px;height:17px;margin:-9px;pointer-events:none;" +
        "z-index:99;" +
        `background:linear-gradient(${RING},${RING}) center/17px 2px no-repeat,` +
        `linear-gradient(${RING},${RING}) center/2px 17px no-repeat`;
      document.body.append(cross);
    }
    cross.style.left = `${x}px`; cross.style.top = `${y}px`;
  };
  const point = (one, kind, [x, y], buttons) => {
    const box = one.getBoundingClientRect();
    // No pointer is there that could be captured.
    one.setPointerCapture = () => {};
    const where = {clientX: box.left + x * box.width, clientY: box.top + y * box.height};
    one.dispatchEvent(new PointerEvent(kind, {...where, buttons, pointerId: 1, pointerType: "mouse",
      isPrimary: true, bubbles: true, composed: true}));
    delete one.setPointerCapture;
  };
  const inFigure = (one, event) => {
    const place = places.get(one) ?? {at: [0.5, 0.4], begun: null};
    places.set(one, place);
    const way = ARROWS[event.key], step = event.shiftKey ? FAST : STEP;
    const within = (part) => Math.min(Math.max(part, 0.01), 0.99);
    if (way) place.at = place.at.map((part, axis) => within(part + step * way[axis]));
    else if (event.key === "Enter") {
      point(one, "pointerdown", place.at, 1);
      point(one, "pointerup", place.at, 0);
    }
    else if (event.key === " " && !place.begun) place.begun = place.at;
    else if (event.key === " ") {
      const parts = [0.25, 0.5, 0.75, 1].map((part) => place.at.map(
        (end, axis) => place.begun[axis] + part * (end - place.begun[axis])));
      point(one, "pointerdown", place.begun, 1);
      for (const part of parts) point(one, "pointermove", part, 1);
      point(one, "pointerup", place.at, 0);
      place.begun = null;
    }
    else if (event.key === "Escape") {
      place.begun = null;
      hide();
      point(one, "pointerout", place.at, 0);
      return true;
    }
    else return false;
    const box = one.getBoundingClientRect();
    show(box.left + place.at[0] * box.width, box.top + place.at[1] * box.height);
    if (way) point(one, "pointermove", place.at, 0);
    return true;
  };
  const inTable = (one, event) => {
    const all = [...one.querySelectorAll(".tabulator-row")];
    const chosen = all.find((row) => row.matches(".tabulator-selected"));
    const was = all.includes(rows.get(one)) ? rows.get(one) : chosen;
    if (event.key === "Enter") { was?.querySelector(".tabulator-cell")?.click(); return Boolean(was) }
    if (event.key !== "ArrowDown" && event.key !== "ArrowUp") return false;
    const beside = event.key === "ArrowDown" ? "nextElementSibling" : "previousElementSibling";
    const next = was ? was[beside] : all[0];
    if (!next) return true;
    if (rows.get(one)) rows.get(one).style.outline = "";
    rows.set(one, next);
    next.style.outline = `3px solid ${RING}`; next.style.outlineOffset = "-3px";
    next.scrollIntoView({block: "nearest"});
    return true;
  };
  const onTab = (one, event) => {
    if (event.key === "Enter" || event.key === " ") { one.click(); return true }
    const next = {ArrowLeft: one.previousElementSibling, ArrowRight: one.nextElementSibling}[event.key];
    next?.focus();
    return Boolean(next);
  };
  window.addEventListener("keydown", (event) => {
    const one = event.composedPath()[0];
    const act = one.matches?.(".bk-events") ? inFigure : one.matches?.(".tabulator-tableholder") ? inTable
      : one.matches?.(".bk-tab") ? onTab : null;
    if (act && !event.ctrlKey && !event.altKey && !event.metaKey && act(one, event)) event.preventDefault();
    setTimeout(() => {
      const now = focused();
      if (now !== one || !now.matches?.(".bk-events")) hide();
      ring(now);
    });
  });
  window.addEventListener("pointerdown", (event) => { if (event.isTrusted) { ring(null); hide() } }, true);
}
"""
