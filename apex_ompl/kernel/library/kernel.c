/* The Python module of the kernel's library: one function for each entry point, over code that numba made ahead of time.
 *
 * An entry point takes all that it is called with from 64-bit slots: where its result goes, where an exception would go,
 * and for every argument a number, or the seven and more fields of an array that numba knows. "entries.h", which
 * scripts/build_kernel.py writes, lists them:
 *
 *     ENTRY(name, "module.name", "kinds of the arguments", "kinds of the result")
 *
 * Kinds are I (int64), D (double), B (bool), a tuple of kinds in parentheses, an array's type q (int64), d (double),
 * f (float), or b (int8) followed by its number of axes, and - for no result.
 *
 * Built against CPython's stable ABI of 3.11 and NumPy 2; this file itself is compiled for any processor, since it tells
 * whether this one can run the rest.
 */
#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#define NPY_TARGET_VERSION NPY_2_0_API_VERSION
#include <Python.h>
#include <math.h>
#include <numpy/arrayobject.h>
#include <stdint.h>
#include <string.h>

#include "settings.h" /* SLOTS, SUPPORTED */

typedef int Code(int64_t *slots);
typedef struct {
    const char *name, *arguments, *result;
    Code *code;
} Entry;

/* What code of numba's calls by these names. */
double numba_frexp(double x, int *exponent) {
    if (isfinite(x) && x != 0.0) return frexp(x, exponent);
    *exponent = 0;
    return x;
}

double numba_ldexp(double x, int exponent) { return isfinite(x) && x != 0.0 && exponent != 0 ? ldexp(x, exponent) : x; }

/* Puts a number into a slot; returns -1 with an exception set if it is none. */
static int put_number(char kind, PyObject *value, int64_t *slot) {
    if (kind == 'D') {
        double number = PyFloat_AsDouble(value);
        memcpy(slot, &number, sizeof number);
        return number == -1.0 && PyErr_Occurred() ? -1 : 0;
    }
    if (kind == 'B') {
        int truth = PyObject_IsTrue(value);
        *slot = truth;
        return truth < 0 ? -1 : 0;
    }
    PyObject *index = PyNumber_Index(value);
    if (!index) return -1;
    *slot = PyLong_AsLongLong(index);
    Py_DecRef(index);
    return *slot == -1 && PyErr_Occurred() ? -1 : 0;
}

/* Puts the fields of an array into slots, and returns the slot after them, or NULL with an exception set. */
static int64_t *put_array(const Entry *entry, const char *kind, PyObject *value, Py_ssize_t place, int64_t *slot) {
    int axes = kind[1] - '0';
    int type = *kind == 'd' ? NPY_DOUBLE : *kind == 'f' ? NPY_FLOAT : *kind == 'b' ? NPY_BYTE : NPY_LONG;
    PyArrayObject *array = (PyArrayObject *)value;
    if (!PyArray_Check(value) || PyArray_TYPE(array) != type || PyArray_NDIM(array) != axes ||
        !PyArray_CHKFLAGS(array, NPY_ARRAY_CARRAY)) {
        const char *name = *kind == 'd' ? "float64" : *kind == 'f' ? "float32" : *kind == 'b' ? "int8" : "int64";
        PyErr_Format(PyExc_TypeError, "argument %zd of %s must be a contiguous, writable array of %s with %d axes",
                     place, entry->name, name, axes);
        return NULL;
    }
    *slot++ = 0; /* no reference is counted */
    *slot++ = 0;
    *slot++ = PyArray_SIZE(array);
    *slot++ = *kind == 'f' ? 4 : *kind == 'b' ? 1 : 8;
    *slot++ = (int64_t)(intptr_t)PyArray_DATA(array);
    for (int k = 0; k < axes; k++) *slot++ = PyArray_DIMS(array)[k];
    for (int k = 0; k < axes; k++) *slot++ = PyArray_STRIDES(array)[k];
    return slot;
}

/* Puts a value of the kind at *kind into slots, moves *kind past it, and returns the slot after them, or NULL. */
static int64_t *put(const Entry *entry, const char **kind, PyObject *value, Py_ssize_t place, int64_t *slot) {
    char first = **kind;
    if (first == '(') {
        Py_ssize_t count = PyTuple_Check(value) ? PyTuple_Size(value) : -1, k = 0;
        for (++*kind; **kind != ')'; k++) {
            if (k >= count) break;
            slot = put(entry, kind, PyTuple_GetItem(value, k), place, slot);
            if (!slot) return NULL;
        }
        if (**kind == ')' && k == count) return ++*kind, slot;
        PyErr_Format(PyExc_TypeError, "argument %zd of %s must be a tuple of another length", place, entry->name);
        return NULL;
    }
    const char *here = *kind;
    if (first == 'I' || first == 'D' || first == 'B') {
        *kind += 1;
        return put_number(first, value, slot) ? NULL : slot + 1;
    }
    *kind += 2;
    return put_array(entry, here, value, place, slot);
}

static PyObject *number(char kind, const int64_t *slot) {
    double value;
    if (kind == 'I') return PyLong_FromLongLong(*slot);
    if (kind == 'B') return PyBool_FromLong(*(const char *)slot);
    memcpy(&value, slot, sizeof value);
    return PyFloat_FromDouble(value);
}

static PyObject *result_of(const char *kind, const int64_t *slots) {
    if (*kind == '-') return Py_NewRef(Py_None);
    if (*kind != '(') return number(*kind, slots);
    Py_ssize_t count = (Py_ssize_t)strlen(kind) - 2;
    PyObject *tuple = PyTuple_New(count);
    for (Py_ssize_t k = 0; tuple && k < count; k++) {
        PyObject *value = number(kind[k + 1], slots + k);
        if (!value || PyTuple_SetItem(tuple, k, value)) {
            Py_DecRef(tuple);
            return NULL;
        }
    }
    return tuple;
}

static PyObject *call(const Entry *entry, PyObject *const *arguments, Py_ssize_t count) {
    int64_t slots[SLOTS], result[16] = {0}, *slot = slots;
    void *exception = NULL;
    *slot++ = (int64_t)(intptr_t)result;
    *slot++ = (int64_t)(intptr_t)&exception;
    const char *kind = entry->arguments;
    Py_ssize_t place = 0;
    while (*kind && place < count) {
        slot = put(entry, &kind, arguments[place], place + 1, slot);
        if (!slot) return NULL;
        place++;
    }
    if (*kind || place != count)
        return PyErr_Format(PyExc_TypeError, "%s takes another number of arguments than %zd", entry->name, count);
    PyThreadState *state = PyEval_SaveThread();
    int status = entry->code(slots);
    PyEval_RestoreThread(state);
    if (status) return PyErr_Format(PyExc_RuntimeError, "%s failed with status %d", entry->name, status);
    return result_of(entry->result, result);
}

#define ENTRY(function, name, arguments, result)                                                              \
    extern Code code_##function;                                                                              \
    static PyObject *call_##function(PyObject *self, PyObject *const *given, Py_ssize_t count) {              \
        static const Entry entry = {name, arguments, result, code_##function};                                \
        (void)self;                                                                                           \
        return call(&entry, given, count);                                                                    \
    }
#include "entries.h"
#undef ENTRY

static PyMethodDef methods[] = {
#define ENTRY(function, name, arguments, result) \
    {name, (PyCFunction)(void *)call_##function, METH_FASTCALL, "The compiled function apex_ompl.kernel.compiled." name},
#include "entries.h"
#undef ENTRY
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_kernel", "The kernel of apex_ompl, built ahead of time.", -1, NULL, NULL, NULL, NULL, NULL};

/* The module has "supported", whether this processor runs the code, and "functions". */
PyMODINIT_FUNC PyInit__kernel(void) {
    import_array();
    PyObject *module = PyModule_Create(&definition), *functions = PyDict_New();
    if (!module || !functions) return NULL;
    for (PyMethodDef *method = methods; method->ml_name; method++) {
        PyObject *function = PyCFunction_NewEx(method, NULL, NULL);
        if (!function || PyDict_SetItemString(functions, method->ml_name, function)) return NULL;
        Py_DecRef(function);
    }
    if (PyModule_AddIntConstant(module, "supported", SUPPORTED) || PyModule_AddObjectRef(module, "functions", functions))
        return NULL;
    Py_DecRef(functions);
    return module;
}
