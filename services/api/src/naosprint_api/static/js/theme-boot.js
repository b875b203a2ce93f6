// Runs before the first paint so that a stored theme never flashes; everything else is in theme.js.
(() => {
  try {
    const theme = localStorage.getItem("naosprint.theme");
    if (theme === "light" || theme === "dark") document.documentElement.dataset.theme = theme;
  } catch (_) {
    /* storage refused: follow the system */
  }
})();
