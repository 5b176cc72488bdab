function told = afspm_ask(address, name, method, path, body)
% AFSPM_ASK  Ask a gateway, and return its answer: told = afspm_ask(address, name, 'get', '/state')
%
% For MATLAB and GNU Octave. Octave's webwrite sends forms and no JSON: there curl sends what has a body.
in_octave = exist('OCTAVE_VERSION', 'builtin') > 0;
url = [address '/v1' path];
if nargin > 4 && in_octave
  command = sprintf('curl -s --fail-with-body -u "%s:%s" -X %s -H "Content-Type: application/json" -d @- "%s"', ...
                    name, getenv('TOKEN'), upper(method), url);
  file = tempname();
  fid = fopen(file, 'w'); fprintf(fid, '%s', jsonencode(body)); fclose(fid);
  [failed, told] = system([command ' < ' file]);
  delete(file);
  if failed
    error('afspm:refused', '%s', told);
  end
else
  options = weboptions('RequestMethod', method, 'Username', name, 'Password', getenv('TOKEN'), 'Timeout', 60);
  if nargin > 4
    options.MediaType = 'application/json';
    told = webwrite(url, body, options);
  else
    told = webread(url, options);
  end
end
if ischar(told)
  told = jsondecode(told);  % MATLAB has done so already
end
end
