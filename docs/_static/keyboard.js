// What scrolls sideways can be scrolled by the keyboard.
addEventListener("load", () => {
  for (const box of document.querySelectorAll("pre, .table-wrapper, .text_html"))
    if (box.scrollWidth > box.clientWidth) box.tabIndex = 0;
});
