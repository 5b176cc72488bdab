-- Runs the scripts of clients, each in a coroutine, and writes their values in Studio's form. Returns
-- start(text, environment), step(script) and helpers.
local fire_limit = 5000000
local format, gsub, find, concat, pack = string.format, string.gsub, string.find, table.concat, table.pack

local function key_text(key)
  if type(key) == "string" then return format("[%q]", key) end
  return "[" .. tostring(key) .. "]"
end

local function written(value, depth)
  local kind = math.type(value)
  if kind == "integer" then return tostring(value) end
  if kind == "float" then
    if value ~= value then return "(0/0)" end
    if value == math.huge then return "math.huge" elseif value == -math.huge then return "-math.huge" end
    local text = format("%.17g", value)
    return find(text, "[%.eE]") and text or text .. ".0"
  end
  kind = type(value)
  if kind == "string" then return (gsub(format("%q", value), "\\\n", "\\n")) end
  if kind == "function" then return "function() end" end
  if kind ~= "table" then return (kind == "boolean" or kind == "nil") and tostring(value) or "nil" end
  if depth > 20 then error("a table is too deep") end
  local parts = {}
  for key, inner in pairs(value) do parts[#parts + 1] = key_text(key) .. "=" .. written(inner, depth + 1) end
  return "{" .. concat(parts, ",") .. "}"
end

local safe = {}
for _, name in ipairs({"pairs", "ipairs", "next", "type", "tostring", "tonumber", "select", "pcall", "error", "rawget"}) do
  safe[name] = _G[name]
end
-- Copies: a script that changes a function must not affect the writing of replies.
for _, name in ipairs({"math", "string", "table"}) do
  safe[name] = {}
  for key, value in pairs(_G[name]) do safe[name][key] = value end
end

-- Scripts may add lasting globals, but can't replace existing ones.
local function environment(root)
  local known = setmetatable({root = root}, {__index = safe})
  return setmetatable({}, {
    __index = known,
    __newindex = function(env, name, value)
      if known[name] ~= nil then error(tostring(name) .. " can't be replaced", 2) end
      rawset(env, name, value)
    end,
  })
end

-- A script that catches the error is ended by the next instruction, and so on until nothing catches it.
local function limited(thread)
  local function too_long()
    debug.sethook(thread, too_long, "", 1)
    error("the script runs too long", 0)
  end
  debug.sethook(thread, too_long, "", fire_limit)
  return thread
end

local function start(text, env)
  local chunk, problem = load(text, "=script", "t", env)
  if not chunk then return nil, "{1,{" .. written(tostring(problem), 0) .. "}}" end
  return {thread = limited(coroutine.create(chunk))}
end

-- Returns nil while the script waits for the instrument, else the reply.
local function step(script)
  local thread = script.thread
  local results = pack(coroutine.resume(thread))
  if not results[1] then return "{1,{" .. written(tostring(results[2]), 0) .. "}}" end
  if coroutine.status(thread) ~= "dead" then return nil end
  local fine, text = pcall(function()
    local parts = {}
    for i = 2, results.n do parts[#parts + 1] = written(results[i], 0) end
    return "{0,{" .. concat(parts, ",") .. "}}"
  end)
  return fine and text or "{1,{" .. written(tostring(text), 0) .. "}}"
end

local function as_function(call)
  return function(...) return call(...) end
end

-- A function that returns once `waiting()` is false, with the message of `outcome()`.
local function blocking(call, waiting, outcome)
  return function(...)
    call(...)
    while waiting() do coroutine.yield() end
    return {message = outcome()}
  end
end

-- Clients share the tree: a script sees it through tables that are empty, so that each assignment reaches `assign`.
local behind = setmetatable({}, {__mode = "k"})
local function guarded(inner, read, assign, fields)
  local node = setmetatable({}, {
    __index = function(_, key)
      local found = inner[key]
      if found == nil and read then return read(key) end
      return found
    end,
    __newindex = function(_, key, value) assign(key, value) end,
    __pairs = function()
      local all = {}
      for key, one in next, inner do all[key] = one end
      for key, access in next, fields or {} do all[key] = access.get() end
      return next, all
    end,
    __metatable = false,
  })
  behind[node] = inner
  return node
end

-- "value", "unit", "min" … can be read and set as fields as well as by value_get() and value_set(v).
local properties = setmetatable({}, {__mode = "k"})
-- Before release 17 there are the fields alone (`bare`).
local function property(fields, enum, bare)
  local inner = {enum = enum}
  for name, access in pairs(bare and {} or fields) do
    inner[name .. "_get"] = as_function(access.get)
    if access.set then inner[name .. "_set"] = as_function(access.set) end
  end
  local function assign(key, value)
    if not (fields[key] and fields[key].set) then error("no such value: " .. tostring(key), 3) end
    fields[key].set(value)
  end
  local node = guarded(inner, function(key) return fields[key] and fields[key].get() end, assign, fields)
  properties[node] = fields.value and "value" or "value_raw"
  return node
end

-- The maker's client says that "root.workflow.imaging.size = value" sets a value. Nothing else can be assigned.
local function branch(inner)
  return guarded(inner, nil, function(key, value)
    local field = properties[inner[key]]
    if not field then error(tostring(key) .. " is no value that can be set", 3) end
    inner[key][field] = value
  end)
end

local function signal()
  local handlers = {}
  local node = {}
  function node.connect(handler) handlers[#handlers + 1] = handler end
  node.connect_extended = node.connect
  function node.empty() return #handlers == 0 end
  function node.call(...)
    for _, handler in ipairs(handlers) do
      if type(handler) == "function" then coroutine.resume(limited(coroutine.create(handler)), ...) end
    end
  end
  return branch(node)
end

local function plain(node)
  local found = {}
  for key, one in next, behind[node] or node do found[key] = type(one) == "table" and plain(one) or one end
  return found
end

-- A function whose first argument, a node of the tree, Python can iterate over.
local function with_plain_tree(call)
  return function(node, ...) return call(plain(node), ...) end
end

return {start = start, step = step, collect = function() collectgarbage() end, environment = environment,
        as_function = as_function, blocking = blocking, property = property, signal = signal, branch = branch,
        with_plain_tree = with_plain_tree}
