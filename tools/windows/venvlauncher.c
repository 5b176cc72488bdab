/* Starts the Python that a virtual environment is made of: what `python -m venv` copies to Scripts\python.exe on Windows,
   which the build of Python for the tests lacks. As CPython's own does it, the environment is told by a variable, the
   command line begins with the Python that is started, and that ends with this process. */
#include <stdio.h>
#include <wchar.h>
#include <windows.h>

#define LONGEST 4096

static BOOL WINAPI leave_to_python(DWORD event) {
    (void)event;
    return TRUE;
}

static const wchar_t *arguments(void) {
    const wchar_t *line = GetCommandLineW();
    wchar_t until = *line == L'"' ? L'"' : L' ';
    const wchar_t *end = wcschr(line + 1, until);
    return end ? end + 1 : L"";
}

/* Write the path of the Python named by "home = ..." in the file beside the folder that this program is in. */
static int find_python(const wchar_t *own, wchar_t *python) {
    static char line[LONGEST];
    int found = 0;
    wcscpy(python, own);
    for (int up = 0; up < 2; up++) *wcsrchr(python, L'\\') = 0;
    wcscat(python, L"\\pyvenv.cfg");
    FILE *file = _wfopen(python, L"rb");
    while (file && !found && fgets(line, sizeof line, file)) {
        line[strcspn(line, "\r\n")] = 0;
        found = !strncmp(line, "home = ", 7) && MultiByteToWideChar(CP_UTF8, 0, line + 7, -1, python, LONGEST - 20);
    }
    if (file) fclose(file);
    return found && wcscat(python, L"\\python.exe");
}

int wmain(void) {
    static wchar_t own[LONGEST], python[LONGEST], command[1 << 15];
    JOBOBJECT_EXTENDED_LIMIT_INFORMATION limits = {0};
    STARTUPINFOW start;
    PROCESS_INFORMATION started;
    DWORD code = 0;
    HANDLE job = CreateJobObjectW(NULL, NULL);

    GetModuleFileNameW(NULL, own, LONGEST);
    if (!find_python(own, python)) return 106;
    swprintf(command, sizeof command / sizeof *command, L"\"%ls\" %ls", python, arguments());
    SetEnvironmentVariableW(L"__PYVENV_LAUNCHER__", own);
    SetConsoleCtrlHandler(leave_to_python, TRUE);
    limits.BasicLimitInformation.LimitFlags = JOB_OBJECT_LIMIT_KILL_ON_JOB_CLOSE | JOB_OBJECT_LIMIT_SILENT_BREAKAWAY_OK;
    SetInformationJobObject(job, JobObjectExtendedLimitInformation, &limits, sizeof limits);
    GetStartupInfoW(&start);
    if (!CreateProcessW(python, command, NULL, NULL, TRUE, 0, NULL, NULL, &start, &started)) return 101;
    AssignProcessToJobObject(job, started.hProcess);
    WaitForSingleObject(started.hProcess, INFINITE);
    GetExitCodeProcess(started.hProcess, &code);
    return code;
}
