// `spm` as SmartScan's scripts see it: values that can be read and set, and methods. Python does the rest.
(function (global) {
  var ask = global.__ask, names = JSON.parse(global.__names);
  function asked(kind, path, given) {
    var reply = JSON.parse(ask(JSON.stringify([kind, path, given])));
    if (reply.error !== undefined) throw reply.error;
    return reply.value;
  }
  function holder(path) {
    var node = global.spm, parts = path.split(".");
    for (var i = 0; i < parts.length - 1; i++) node = node[parts[i]] = node[parts[i]] || {};
    return node;
  }
  global.spm = {};
  names.values.forEach(function (path) {
    Object.defineProperty(holder(path), path.split(".").pop(), {
      enumerable: true,
      get: function () { return asked("get", path, []); },
      set: function (value) { asked("set", path, [value]); }
    });
  });
  names.methods.forEach(function (path) {
    holder(path)[path.split(".").pop()] = function () { return asked("call", path, Array.prototype.slice.call(arguments)); };
  });
  global.print = function () {};
  Date.now = function () { return asked("now", "", []); };  // scripts wait by it, at the experiment's speed
  // the value of a script as it is, and as text; an object's text is not its content
  global.__run = function (script) {
    var value = (0, eval)(script);
    return JSON.stringify([value === undefined ? null : value, value === undefined ? "" : String(value)]);
  };
  ["__ask", "__names"].forEach(function (name) { delete global[name]; });
})(this);
