% Takes a scan over HTTP in MATLAB, and in GNU Octave: octave --no-gui scan.m [ADDRESS [NAME]]
1;  % a script for Octave, too

function told = ask(address, name, method, path, body)
  % Return the answer to a request. Octave's webwrite sends forms and no JSON: there curl sends what has a body.
  url = [address "/v1" path];
  if exist("OCTAVE_VERSION", "builtin") && nargin > 4
    command = sprintf("curl -s --fail-with-body -u %s: -X %s -H 'Content-Type: application/json' -d '%s' '%s'", ...
                      name, upper(method), jsonencode(body), url);
    [failed, text] = system(command);
    if failed
      error("%s", text);
    end
    told = jsondecode(text);
    return
  end
  options = weboptions("RequestMethod", method, "Username", name, "Password", "", "Timeout", 60, ...
                       "ContentType", "json");
  if nargin > 4
    options.MediaType = "application/json";
    told = webwrite(url, body, options);
  else
    told = webread(url, options);
  end
end

address = "http://127.0.0.1:8090";
name = "matlab";
if exist("OCTAVE_VERSION", "builtin") && numel(argv()) >= 2
  arguments = argv();
  [address, name] = arguments{end-1:end};
end

state = ask(address, name, "get", "/state");
printf("%s, the microscope is %s\n", state.mode, state.microscope.state);
ask(address, name, "post", "/control?wait_s=20");  % with the usual lease of 60 s
ask(address, name, "put", "/parameters/tip-bias-voltage", struct("value", "500 mV"));
region = struct("center_m", [1e-6 0], "size_m", [5e-7 5e-7]);
ask(address, name, "post", "/scans", struct("region", region, "shape", [64 64], "key", [name "-1"]));
measured = struct("state", "running");
while strcmp(measured.state, "running")
  measured = ask(address, name, "get", ["/measurements/" name "-1?wait_s=20"]);
end
told = ask(address, name, "get", ["/scans/" measured.result "/values?channel=Height&format=base64"]);
if exist("OCTAVE_VERSION", "builtin")
  heights = base64_decode(told.base64);
else
  heights = typecast(matlab.net.base64decode(told.base64), "double");
end
heights = reshape(heights, fliplr(told.shape(:)'))';  % row after row
printf("%d x %d pixels, the highest at %.1f nm\n", size(heights), max(heights(:)) * 1e9);
ask(address, name, "delete", "/control");
